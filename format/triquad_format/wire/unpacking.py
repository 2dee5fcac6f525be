"""Unpacking of msgpack that others sent: small payloads take little memory, and all little time.

A few megabytes can contain millions of tiny objects: unpacking them would block everything else for
seconds and take a hundred times their size.
"""

from typing import Any

import msgpack

from triquad_format.errors import WireError

MAX_OBJECTS = 20_000
_MAX_DEPTH = 16
_MAX_STRING_BYTES = 65_536
# Room for a list is taken before its items are seen, and 1024 may be within each other.
_MAX_LIST_ITEMS = 64
_MAX_MAP_ITEMS = 4096


def unpacked(payload: bytes) -> object:
    """Return the object that a payload is.

    Raises:
        WireError: it is no whole msgpack object, has one of an extension type, is too deep, or made
            of too many objects.
    """
    left = MAX_OBJECTS

    def counted(items: list[Any]) -> list[Any]:
        nonlocal left
        left -= len(items)
        if left < 0:
            raise WireError(f"more than {MAX_OBJECTS} objects")
        return items

    try:
        value = msgpack.unpackb(
            payload,
            list_hook=counted,
            object_pairs_hook=lambda pairs: dict(counted(pairs)),
            max_str_len=_MAX_STRING_BYTES,
            max_array_len=_MAX_LIST_ITEMS,
            max_map_len=_MAX_MAP_ITEMS,
            max_ext_len=0,
        )
    except (ValueError, TypeError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"not msgpack: {error or type(error).__name__}") from error
    if not _is_shallow(value, _MAX_DEPTH):
        raise WireError(f"nested more than {_MAX_DEPTH} deep")
    return value


def _is_shallow(value: object, levels: int) -> bool:
    """Return whether an object has at most ``levels`` of lists and maps within each other."""
    if not isinstance(value, (dict, list)):
        return True
    items = value.values() if isinstance(value, dict) else value
    return levels > 0 and all(_is_shallow(item, levels - 1) for item in items)
