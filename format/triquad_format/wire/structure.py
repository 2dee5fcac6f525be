"""A check of the structure of a msgpack message before anything is built from it.

A message of a few megabytes can hold millions of tiny objects, or nest thousands deep; unpacking it
would hold up everything else for seconds and take a hundred times its size. Reading the headers
alone tells: https://github.com/msgpack/msgpack/blob/master/spec.md
"""

from collections.abc import Iterator

from triquad_format.errors import WireError

MAX_OBJECTS = 20_000
MAX_DEPTH = 16

# Floating-point numbers, unsigned and signed integers.
_NUMBER_BYTES = dict(zip(range(0xCA, 0xD4), (4, 8, 1, 2, 4, 8, 1, 2, 4, 8), strict=True))
_LENGTH_BYTES = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}  # binaries and strings
_BINARIES = (0xC4, 0xC5, 0xC6)
_COUNT_BYTES = {0xDC: 2, 0xDD: 4, 0xDE: 2, 0xDF: 4}  # arrays and maps
_SINGLE = (0xC0, 0xC2, 0xC3)  # nil, false, true


def check_structure(payload: bytes, max_objects: int = MAX_OBJECTS) -> None:
    """Refuse a msgpack object that is incomplete, too deep, or made of too many objects.

    Raises:
        WireError: the text says which.
    """
    at = 0
    objects = 0
    open_items = [1]
    while open_items:
        if open_items[-1] == 0:
            open_items.pop()
            continue
        open_items[-1] -= 1
        objects += 1
        if at >= len(payload):
            raise WireError("not a triquad message: it is incomplete")
        at, children = _header(payload, at)
        if objects + children > max_objects:
            raise WireError(f"not a triquad message: more than {max_objects} objects")
        if children:
            open_items.append(children)
        if len(open_items) > MAX_DEPTH:
            raise WireError(f"not a triquad message: nested more than {MAX_DEPTH} deep")
    if at != len(payload):
        raise WireError("not a triquad message: it is incomplete, or something follows it")


def binary_offsets(payload: bytes) -> Iterator[range]:
    """Where the bytes of each binary lie in a valid msgpack object, in their order."""
    at, objects = 0, 1
    while objects:
        code = payload[at]
        end, children = _header(payload, at)
        if code in _BINARIES:
            yield range(at + 1 + _LENGTH_BYTES[code], end)
        at, objects = end, objects - 1 + children


def _header(payload: bytes, at: int) -> tuple[int, int]:
    """Where the next header is, and how many objects the one at ``at`` announces."""
    code = payload[at]
    at += 1
    if code <= 0x7F or code >= 0xE0 or code in _SINGLE:
        return at, 0
    if code <= 0x8F:
        return at, 2 * (code & 0x0F)
    if code <= 0x9F:
        return at, code & 0x0F
    if code <= 0xBF:
        return at + (code & 0x1F), 0
    if code in _NUMBER_BYTES:
        return at + _NUMBER_BYTES[code], 0
    if code in _LENGTH_BYTES:
        size = _LENGTH_BYTES[code]
        return at + size + int.from_bytes(payload[at : at + size], "big"), 0
    if code in _COUNT_BYTES:
        size = _COUNT_BYTES[code]
        count = int.from_bytes(payload[at : at + size], "big")
        return at + size, count if code <= 0xDD else 2 * count
    raise WireError(f"not a triquad message: type {code:#x} does not occur in one")
