"""Files on a disk: read from any place, written whole and durably or not at all."""

import contextlib
import errno
import io
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    TooLargeMapFileError,
)

DAMAGED_SUFFIX = ".damaged"
"""Added to the names of files that are set aside."""

_REMEDY = "triquad-pack --recover saves what is intact; an older checkpoint may be intact"


@contextlib.contextmanager
def named(name: str) -> Iterator[None]:
    """Put the file's name and, for damage, the remedy into what is raised.

    Raises:
        MapFileError: instead of any :class:`FormatError`, and where memory does not suffice.
    """
    try:
        yield
    except FormatError as error:
        if isinstance(error, MapFileError) and not isinstance(error, DamagedMapFileError):
            raise type(error)(f"{name}: {error}") from error
        raise DamagedMapFileError(f"{name} is damaged: {error}; {_REMEDY}") from error
    except MemoryError as error:
        raise TooLargeMapFileError(f"{name}: the map does not fit into memory") from error


def open_regular(path: Path) -> io.FileIO:
    """Return a file for reading; a pipe or device, which could keep its reader waiting, is refused.

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
        """Open a file; errors are those of :func:`open_regular`."""
        self.name = str(path)
        self._stream = open_regular(path)
        self.size = os.fstat(self._stream.fileno()).st_size

    def read(self, offset: int, length: int) -> bytes:
        """Read as :meth:`RandomAccess.read`; threads may read at the same time."""
        check_range(offset, length, self.size)
        data = os.pread(self._stream.fileno(), length, offset)
        while len(data) < length:
            more = os.pread(self._stream.fileno(), length - len(data), offset + len(data))
            if not more:
                raise DamagedMapFileError(f"it was cut to {offset + len(data)} bytes meanwhile")
            data += more
        return data

    def drop_cached(self) -> None:
        """Have the system read the file from its disk, not from what it has in memory of it."""
        os.posix_fadvise(self._stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def check_range(offset: int, length: int, size: int) -> None:
    """Raise :class:`DamagedMapFileError` unless the file's ``size`` bytes contain that range."""
    if offset < 0 or length < 0 or offset + length > size:
        raise DamagedMapFileError(
            f"bytes {offset} to {offset + length} are needed, but it has {size}: it is incomplete"
        )


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a stream whose bytes replace the file at ``path``, durably, where nothing is raised.

    Raises:
        OSError: the file cannot be written, or what is there is none, such as a device; it is
            named, and what was there stays.
    """
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, "it is no file, and is not replaced", str(path))
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with naming(path):
            with temporary.open("xb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Have errors of the system name a file, where they name none.

    Raises:
        OSError: what is raised within, with a name.
    """
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
        raise


def sync_folder(folder: Path) -> None:
    """Make renames in a folder durable, where the system lets folders be synced.

    Raises:
        OSError: the folder cannot be synced.
    """
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
