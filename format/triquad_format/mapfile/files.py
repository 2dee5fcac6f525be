"""Files of maps: read from any place, replaced as a whole, and named in errors."""

import contextlib
import io
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Protocol

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    TooLargeMapFileError,
)

_REMEDY = "triquad-pack --recover saves what is intact; an older checkpoint may be intact"


class RandomAccess(Protocol):
    """Where a map file's bytes come from."""

    name: str
    size: int  # bytes

    def read(self, offset: int, length: int) -> bytes:
        """Exactly ``length`` bytes from ``offset`` on.

        Raises:
            DamagedMapFileError: there are not so many.
            OSError: they cannot be read.
        """
        ...

    def close(self) -> None:
        """Close the source."""
        ...


def open_regular(path: Path) -> io.FileIO:
    """A file for reading; a pipe or device, which could keep its reader waiting, is refused.

    Raises:
        MapFileError: it is no regular file.
        OSError: it cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise MapFileError(f"{path} is not a regular file")
    return io.FileIO(descriptor)


class FileBytes:
    """The bytes of a file; they stay readable while it is open, even where it is deleted."""

    def __init__(self, path: Path) -> None:
        self.name = str(path)
        self._stream = open_regular(path)
        self.size = os.fstat(self._stream.fileno()).st_size
        self.bytes_read = 0

    def read(self, offset: int, length: int) -> bytes:
        """As :meth:`RandomAccess.read`; threads may read at the same time."""
        check_range(offset, length, self.size)
        data = os.pread(self._stream.fileno(), length, offset)
        while len(data) < length:
            more = os.pread(self._stream.fileno(), length - len(data), offset + len(data))
            if not more:
                raise DamagedMapFileError(f"it was cut to {offset + len(data)} bytes meanwhile")
            data += more
        self.bytes_read += length
        return data

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def check_range(offset: int, length: int, size: int) -> None:
    """Raise :class:`DamagedMapFileError` unless the bytes lie within ``size``."""
    if offset < 0 or length < 0 or offset + length > size:
        raise DamagedMapFileError(
            f"bytes {offset} to {offset + length} are needed, but it has {size}: it is incomplete"
        )


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A stream whose bytes replace the file at ``path``, durably, where nothing is raised."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make renames in a folder durable, where the system lets folders be synced."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def named(name: str) -> Iterator[None]:
    """Put the file's name and, for damage, the remedy into what is raised."""
    try:
        yield
    except FormatError as error:
        if isinstance(error, MapFileError) and not isinstance(error, DamagedMapFileError):
            raise type(error)(f"{name}: {error}") from error
        raise DamagedMapFileError(f"{name} is damaged: {error}; {_REMEDY}") from error
    except MemoryError as error:
        raise TooLargeMapFileError(f"{name}: the map does not fit into memory") from error
