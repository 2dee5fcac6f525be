"""A map file opened by its index: its manifest at once, each part when it is asked for."""

import contextlib
import hashlib
import io
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    NoIndexError,
    TooLargeMapFileError,
)
from triquad_format.mapfile.manifest import Entry, FileRef, unpack_manifest
from triquad_format.mapfile.mcap.reader import McapIndex, RandomAccess
from triquad_format.mapfile.metadata import (
    METADATA_NAME,
    check_agreement,
    check_map_part,
    readable_metadata,
)
from triquad_format.mapfile.parts.part import MANIFEST, MAP, PartKey

DAMAGED_SUFFIX = ".damaged"
"""Added to the names of files that are set aside."""

_REMEDY = "triquad-pack --recover saves what is intact; an older checkpoint may be intact"

OpenFile = Callable[[FileRef], RandomAccess]
"""Opens another file of the same folder."""


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
        """Open a file; errors are those of :func:`open_regular`."""
        self.name = str(path)
        self._stream = open_regular(path)
        self.size = os.fstat(self._stream.fileno()).st_size

    def read(self, offset: int, length: int) -> bytes:
        """As :meth:`RandomAccess.read`; threads may read at the same time."""
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
    """Raise :class:`DamagedMapFileError` unless the file's ``size`` bytes hold that range."""
    if offset < 0 or length < 0 or offset + length > size:
        raise DamagedMapFileError(
            f"bytes {offset} to {offset + length} are needed, but it has {size}: it is incomplete"
        )


def files_in(folder: Path) -> OpenFile:
    """Opens the other files that hold parts of a map, in the folder of the map file.

    One that was set aside as damaged is opened, too: its parts are checked one by one.
    """

    return lambda file: FileBytes(file_in(folder, file.name))


def file_in(folder: Path, name: str) -> Path:
    """The file of this name; where it was set aside as damaged, under its new name."""
    aside = folder / (name + DAMAGED_SUFFIX)
    return aside if aside.exists() and not (folder / name).exists() else folder / name


class OtherFiles:
    """The other files that hold parts of a map; each is opened when it is needed."""

    def __init__(self, open_file: OpenFile | None) -> None:
        self._open_file = open_file
        self._indices: dict[FileRef, MapIndex] = {}

    def payload(self, entry: Entry) -> bytes:
        """The payload of a part that another file holds.

        Raises:
            MapFileError: that file is missing, damaged or another.
            OSError: the system refuses to read it.
        """
        assert entry.file is not None
        if entry.file not in self._indices:
            self._indices[entry.file] = self._open(entry.file)
        index = self._indices[entry.file]
        try:
            return index.payload(index.find(entry))
        except MapFileError as error:
            raise DamagedMapFileError(f"{entry.file.name}, which holds parts: {error}") from error

    def close(self) -> None:
        """Close those that were opened."""
        for index in self._indices.values():
            index.close()

    def _open(self, file: FileRef) -> "MapIndex":
        if self._open_file is None:
            raise MapFileError(f"parts lie in {file.name}, which cannot be reached from here")
        try:
            source = self._open_file(file)
            try:
                index = MapIndex(source)
                if index.manifest_sha256 != file.manifest_sha256:
                    raise DamagedMapFileError("it is not the file that the map was made with")
                return index
            except BaseException:
                source.close()
                raise
        except FileNotFoundError as error:
            raise DamagedMapFileError(
                f"{file.name}, which holds parts, is missing; put it beside this file"
            ) from error
        except FormatError as error:
            raise DamagedMapFileError(f"{file.name}, which holds parts: {error}") from error


class MapIndex:
    """The manifest of a map file, and its parts by random access.

    What is read is checked: the summary and the manifest by their checksums, each part by its
    digest. What is not read is not.
    """

    def __init__(self, source: RandomAccess, open_file: OpenFile | None = None) -> None:
        """Read metadata and manifest.

        Args:
            source: the file; it is closed with this index.
            open_file: opens the other files that hold parts; needed where there are any.

        Raises:
            MapFileError: it is not a map file, is damaged, or needs a newer reader.
        """
        self._source = source
        self._others = OtherFiles(open_file)
        self._mcap = McapIndex(source)
        self.metadata = readable_metadata(self._mcap.metadata(METADATA_NAME))
        last = self._mcap.chunks - 1
        message = self._mcap.message(last) if last >= 0 else None
        if message is None or message.channel.topic != MANIFEST:
            raise NoIndexError("its last chunk is not its manifest: triquad-pack rewrites it")
        self.manifest = unpack_manifest(message.data, source.size)
        self.manifest_sha256 = hashlib.sha256(message.data).digest()
        own = self.manifest.own
        if len(own) != last:
            raise DamagedMapFileError(f"{last} parts, but its manifest lists {len(own)}")
        needs_others = bool(self.manifest.files)
        check_agreement(self.metadata, self.manifest.facts, needs_other_files=needs_others)
        self._numbers = {entry.key: number for number, entry in enumerate(own)}
        self._own = {entry.key: entry for entry in own}
        if (stated := self._own.get(PartKey(MAP))) is not None:
            check_map_part(self.payload(stated), self.manifest.facts)

    def close(self) -> None:
        """Close this file and the others that were opened."""
        self._source.close()
        self._others.close()

    def payload(self, entry: Entry) -> bytes:
        """The payload of a part that the manifest lists.

        Raises:
            MapFileError: the part is damaged, or the file that holds it is missing or another.
            OSError: a file cannot be read.
        """
        if entry.file is not None:
            return self._others.payload(entry)
        number = self._numbers[entry.key]
        message = self._mcap.message(number)
        entry.check(number, message.channel.topic, message.data)
        return message.data

    def find(self, entry: Entry) -> Entry:
        """The part of this file that another file's ``entry`` is about.

        Raises:
            DamagedMapFileError: the file does not hold it.
        """
        own = self._own.get(entry.key)
        if own is None or own.sha256 != entry.sha256:
            raise DamagedMapFileError(f"it does not hold {entry.key}")
        return own
