"""The structure of msgpack objects, which is checked before they are unpacked.

A few megabytes can contain millions of tiny objects, or nest thousands deep; unpacking them would
block everything else for seconds and take a hundred times their size. The headers alone are read,
whose bytes are those of https://github.com/msgpack/msgpack/blob/master/spec.md
"""

from collections.abc import Iterator

from triquad_format.errors import WireError

MAX_OBJECTS = 20_000
_MAX_DEPTH = 16

# How many bytes follow the first of a header: a length, or a count.
_LENGTH_BYTES = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}  # binaries and strings
_COUNT_BYTES = {0xDC: 2, 0xDD: 4, 0xDE: 2, 0xDF: 4}  # arrays and maps


def _sizes() -> bytes:
    """Return an object's size by its first byte; 0: it does not give it, or contains others."""
    sizes = bytearray(256)
    for code in (*range(0x80), *range(0xE0, 0x100), 0xC0, 0xC2, 0xC3):  # small numbers, nil, truth
        sizes[code] = 1
    for code in range(0xA0, 0xC0):  # short strings
        sizes[code] = 1 + (code & 0x1F)
    for code, size in zip(range(0xCA, 0xD4), (4, 8, 1, 2, 4, 8, 1, 2, 4, 8), strict=True):
        sizes[code] = 1 + size  # numbers
    return bytes(sizes)


_SIZES = _sizes()


def check_structure(payload: bytes, max_objects: int = MAX_OBJECTS) -> None:
    """Refuse a msgpack object that is incomplete, too deep, or made of too many objects.

    Raises:
        WireError: the text says which.
    """
    at, objects = 0, 1  # as many as the headers so far announce
    missing, around = 1, [0]  # objects still to come, in the innermost one and in those around it
    while missing or len(around) > 1:
        if not missing:
            missing = around.pop()
            continue
        if at >= len(payload):
            raise WireError("not a triquad message: it is incomplete")
        missing -= 1
        size = _SIZES[payload[at]]
        if size:
            at += size
            continue
        at, children = _header(payload, at)
        objects += children
        if objects > max_objects:
            raise WireError(f"not a triquad message: more than {max_objects} objects")
        if children:
            around.append(missing)
            missing = children
        if len(around) > _MAX_DEPTH:
            raise WireError(f"not a triquad message: nested more than {_MAX_DEPTH} deep")
    if at != len(payload):
        raise WireError("not a triquad message: it is incomplete, or something follows it")


def binary_offsets(payload: bytes) -> Iterator[range]:
    """Yield where the bytes of each binary lie in a valid msgpack object, in their order."""
    at, objects = 0, 1
    while objects:
        code = payload[at]
        end, children = _header(payload, at)
        if 0xC4 <= code <= 0xC6:
            yield range(at + 1 + _LENGTH_BYTES[code], end)
        at, objects = end, objects - 1 + children


def _header(payload: bytes, at: int) -> tuple[int, int]:
    """Return where the next header is, and how many objects the one at ``at`` announces."""
    code = payload[at]
    if _SIZES[code]:
        return at + _SIZES[code], 0
    at += 1
    if code <= 0x8F:
        return at, 2 * (code & 0x0F)
    if code <= 0x9F:
        return at, code & 0x0F
    if code in _LENGTH_BYTES:
        size = _LENGTH_BYTES[code]
        return at + size + int.from_bytes(payload[at : at + size], "big"), 0
    if code in _COUNT_BYTES:
        size = _COUNT_BYTES[code]
        count = int.from_bytes(payload[at : at + size], "big")
        return at + size, count if code <= 0xDD else 2 * count
    raise WireError(f"not a triquad message: type {code:#x} does not occur in one")
