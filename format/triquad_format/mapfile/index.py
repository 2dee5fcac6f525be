"""A map file opened by its end: its manifest at once, each part when it is asked for."""

import contextlib
import io
import os
import stat
import zlib
from collections.abc import Iterator
from pathlib import Path

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    TooLargeMapFileError,
)
from triquad_format.mapfile.container import RandomAccess, decompress, read_end, read_message
from triquad_format.mapfile.manifest import Entry, manifest_in
from triquad_format.mapfile.metadata import (
    check_agreement,
    check_map_part,
    check_readable,
    manifest_place,
)
from triquad_format.mapfile.parts.body import unpack_body
from triquad_format.mapfile.parts.part import MANIFEST, MAP, PREFIX, REGION_TOPICS, PartKey

DAMAGED_SUFFIX = ".damaged"
"""Added to the names of files that are set aside."""

_REMEDY = "triquad-pack --recover saves what is intact; an older checkpoint may be intact"
_BLOCK_BYTES = 1 << 20


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


class MapIndex:
    """The manifest of a map file, and its parts by random access.

    What is read is checked: the summary by its checksum, the manifest by that of its chunk, each
    part by its digest. What is not read is not.
    """

    def __init__(self, source: RandomAccess) -> None:
        """Read metadata and manifest of the file, which is closed with this index.

        Raises:
            MapFileError: it is not a map file, is damaged, or needs a newer reader.
        """
        self._source = source
        self.size = source.size  # bytes
        self._end = read_end(source)
        self.metadata = self._end.metadata  # of the record "triquad"
        check_readable(self.metadata)
        try:
            packed = decompress(read_message(source, *manifest_place(self.metadata)))
            self.manifest = manifest_in(unpack_body(MANIFEST, packed), source.size)
            self.manifest.check_total(source.size)
        except DamagedMapFileError as error:
            raise DamagedMapFileError(f"{error} (or another program rewrote it)") from error
        check_agreement(self.metadata, self.manifest.facts)
        stated = [entry for entry in self.manifest.entries if entry.key == PartKey(MAP)]
        if not stated:
            raise DamagedMapFileError(f"its manifest does not list the part {MAP}")
        check_map_part(self.payload(stated[0]), self.manifest.facts)

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def check_unread(self) -> None:
        """Check what no reader of the map uses: bytes between the parts, and parts of other topics.

        Raises:
            DamagedMapFileError: something of it is damaged.
        """
        crc = 0
        for first in range(0, self._end.data_bytes, _BLOCK_BYTES):
            size = min(_BLOCK_BYTES, self._end.data_bytes - first)
            crc = zlib.crc32(self._source.read(first, size), crc)
        if crc != self._end.data_crc:
            raise DamagedMapFileError("the data section fails its checksum")
        for entry in self.manifest.entries:
            if entry.key.topic not in (MAP, *REGION_TOPICS):
                self.payload(entry)

    def payload(self, entry: Entry) -> bytes:
        """Return the payload of a part that the manifest lists.

        Raises:
            DamagedMapFileError: it is not there, or not the part that is listed.
            OSError: the file cannot be read.
        """
        try:
            data = read_message(self._source, entry.offset, entry.stored)
            if entry.key.topic.startswith(PREFIX):
                data = decompress(data, entry.size)
            entry.check(data)
        except DamagedMapFileError as error:
            raise DamagedMapFileError(f"{entry.key.topic:.80}: {error}") from error
        return data
