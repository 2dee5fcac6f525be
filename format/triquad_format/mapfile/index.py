"""A map file opened by its end: its manifest at once, each part when it is asked for."""

import contextlib
import io
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    TooLargeMapFileError,
)
from triquad_format.mapfile.container import RandomAccess, decompress, read_end, read_message
from triquad_format.mapfile.manifest import Entry, unpack_manifest
from triquad_format.mapfile.metadata import (
    check_agreement,
    check_map_part,
    check_readable,
    manifest_place,
)
from triquad_format.mapfile.parts.part import MAP, PREFIX, PartKey

DAMAGED_SUFFIX = ".damaged"
"""Added to the names of files that are set aside."""

_REMEDY = "triquad-pack --recover saves what is intact; an older checkpoint may be intact"

OpenFile = Callable[[str], RandomAccess]
"""Opens another file of the same folder by its name."""


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


class MemoryBytes:
    """The bytes of a file that are in memory."""

    def __init__(self, data: bytes, name: str = "map file") -> None:
        self.name = name
        self.size = len(data)
        self.data = data

    def read(self, offset: int, length: int) -> bytes:
        """Read as :meth:`RandomAccess.read`."""
        check_range(offset, length, self.size)
        return self.data[offset : offset + length]

    def close(self) -> None:
        """Do nothing: there is no file."""


def check_range(offset: int, length: int, size: int) -> None:
    """Raise :class:`DamagedMapFileError` unless the file's ``size`` bytes contain that range."""
    if offset < 0 or length < 0 or offset + length > size:
        raise DamagedMapFileError(
            f"bytes {offset} to {offset + length} are needed, but it has {size}: it is incomplete"
        )


def files_in(folder: Path) -> OpenFile:
    """Opens the other files that contain parts of a map, in the folder of the map file.

    One that was set aside as damaged is opened, too: its parts are checked one by one.
    """

    return lambda name: FileBytes(file_in(folder, name))


def file_in(folder: Path, name: str) -> Path:
    """Return the file of this name; where it was set aside as damaged, under its new name."""
    aside = folder / (name + DAMAGED_SUFFIX)
    return aside if aside.exists() and not (folder / name).exists() else folder / name


def _payload(source: RandomAccess, entry: Entry) -> bytes:
    """Return the payload of a part in the file that contains it.

    Raises:
        DamagedMapFileError: it is not there, or not the part that is listed.
    """
    try:
        data = read_message(source, entry.offset, entry.stored)
        if entry.key.topic.startswith(PREFIX):
            data = decompress(data, entry.size)
        entry.check(data)
    except DamagedMapFileError as error:
        raise DamagedMapFileError(f"{entry.key.topic:.80}: {error}") from error
    return data


class OtherFiles:
    """The other files that contain parts of a map; each is opened when it is needed."""

    def __init__(self, open_file: OpenFile | None) -> None:
        self._open_file = open_file
        self._open: dict[str, RandomAccess] = {}

    def payload(self, entry: Entry) -> bytes:
        """Return the payload of a part that another file contains.

        Raises:
            MapFileError: that file is missing, damaged or another.
            OSError: the system refuses to read it.
        """
        assert entry.file is not None
        if self._open_file is None:
            raise MapFileError(f"parts lie in {entry.file}, which cannot be reached from here")
        try:
            if entry.file not in self._open:
                self._open[entry.file] = self._open_file(entry.file)
            return _payload(self._open[entry.file], entry)
        except FileNotFoundError as error:
            raise DamagedMapFileError(
                f"{entry.file}, which holds parts, is missing; copy it into the folder of this file"
            ) from error
        except FormatError as error:
            raise DamagedMapFileError(f"{entry.file}, which holds parts: {error}") from error

    def close(self) -> None:
        """Close those that were opened."""
        for source in self._open.values():
            source.close()


class MapIndex:
    """The manifest of a map file, and its parts by random access.

    What is read is checked: the summary by its checksum, the manifest by that of its chunk, each
    part by its digest. What is not read is not.
    """

    def __init__(self, source: RandomAccess, open_file: OpenFile | None = None) -> None:
        """Read metadata and manifest.

        Args:
            source: the file; it is closed with this index.
            open_file: opens the other files that contain parts; needed where there are any.

        Raises:
            MapFileError: it is not a map file, is damaged, or needs a newer reader.
        """
        self._source = source
        self._others = OtherFiles(open_file)
        self.end = read_end(source)
        check_readable(self.end.metadata)
        try:
            packed = decompress(read_message(source, *manifest_place(self.end.metadata)))
            self.manifest = unpack_manifest(packed, source.size)
        except DamagedMapFileError as error:
            raise DamagedMapFileError(f"{error} (or another program rewrote it)") from error
        check_agreement(self.end.metadata, self.manifest.facts)
        stated = next(entry for entry in self.manifest.own if entry.key == PartKey(MAP))
        check_map_part(self.payload(stated), self.manifest.facts)

    def close(self) -> None:
        """Close this file and the others that were opened."""
        self._source.close()
        self._others.close()

    def payload(self, entry: Entry) -> bytes:
        """Return the payload of a part that the manifest lists.

        Raises:
            MapFileError: the part is damaged, or the file that contains it is missing or another.
            OSError: a file cannot be read.
        """
        return _payload(self._source, entry) if entry.file is None else self._others.payload(entry)
