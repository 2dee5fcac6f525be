"""Errors in reading a map file, told with its name."""

import contextlib
from collections.abc import Iterator

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    NoIndexError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)

_REMEDY = "triquad-pack --recover saves what is intact; an older checkpoint may be intact"


@contextlib.contextmanager
def named(name: str) -> Iterator[None]:
    """Put the file's name and, for damage, the remedy into what is raised."""
    try:
        yield
    except (NoIndexError, UnsupportedMapFileError, TooLargeMapFileError) as error:
        raise type(error)(f"{name}: {error}") from error
    except DamagedMapFileError as error:
        raise DamagedMapFileError(f"{name} is damaged: {error}; {_REMEDY}") from error
    except MapFileError as error:
        raise MapFileError(f"{name}: {error}") from error
    except FormatError as error:
        raise DamagedMapFileError(f"{name} is damaged: {error}; {_REMEDY}") from error
    except MemoryError as error:
        raise TooLargeMapFileError(f"{name}: the map does not fit into memory") from error
