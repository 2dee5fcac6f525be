"""The parts of a map file, or of a checkpoint, each read when it is asked for.

A checkpoint is a small file that lists the parts of a map at one epoch, which lie in a folder next
to it: :mod:`triquad_format.mapfile.checkpoint_folder`. It is one line that says what the file is,
the SHA-256 of the rest, and a zstd frame with the manifest.
"""

import hashlib
import zlib
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import zstandard

from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.checkpoint_folder import PartFiles
from triquad_format.mapfile.container import RandomAccess, decompress, read_end, read_message
from triquad_format.mapfile.files import FileBytes, named, replacing
from triquad_format.mapfile.manifest import (
    DIGEST_BYTES,
    Entry,
    Manifest,
    manifest_in,
    pack_manifest,
)
from triquad_format.mapfile.metadata import (
    PRODUCER,
    check_agreement,
    check_map_part,
    check_readable,
    manifest_place,
    utc_time,
    version_of,
)
from triquad_format.mapfile.parts.body import PartBody, unpack_body
from triquad_format.mapfile.parts.part import (
    MANIFEST,
    MAP,
    MAX_PART_BYTES,
    PREFIX,
    REGION_TOPICS,
    PartKey,
)
from triquad_format.mapfile.region_facts import (
    FactsByRegion,
    pack_region_facts,
    region_facts_in,
)
from triquad_format.mapfile.writer import MapFileInfo

_BLOCK_BYTES = 1 << 20

MAGIC = b"triquad checkpoint\n"

MAX_CHECKPOINT_BYTES = 2**48
"""Limit on the parts of a checkpoint together, whose regions are read one by one."""

_LEVEL = 3  # of zstd; digests do not shrink


@dataclass(frozen=True)
class Restored:
    """An older checkpoint that the map was restored to."""

    epoch: int
    as_epoch: int  # under which the map went on


@dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint's file."""

    manifest: Manifest
    undoes: str = ""
    """What going back to it undoes, such as a reset: so it stays longer. Empty: nothing."""

    restored: Restored | None = None  # the last time that the map was restored
    regions: FactsByRegion | None = None  # None: an earlier release wrote it, and told none


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> MapFileInfo:
    """Write a checkpoint whose parts are there, all of it or nothing; return size and digest.

    Raises:
        FormatError: it lists more than it may, or the map is too large to be read.
        OSError: it cannot be written.
    """
    manifest = checkpoint.manifest
    manifest.check_total(manifest.stored_bytes, MAX_CHECKPOINT_BYTES)
    more: dict[str, object] = {"producer": PRODUCER, "undoes": checkpoint.undoes}
    if checkpoint.restored is not None:
        more["restored"] = vars(checkpoint.restored)
    if checkpoint.regions is not None:
        more["regions"] = pack_region_facts(checkpoint.regions)
    part = pack_manifest(checkpoint.manifest, more)
    frame = zstandard.ZstdCompressor(level=_LEVEL).compress(part.payload)
    data = MAGIC + hashlib.sha256(frame).digest() + frame
    with replacing(path) as file:
        file.write(data)
    digest = hashlib.sha256(data).hexdigest()
    return MapFileInfo(len(data), digest, checkpoint.manifest.facts.epoch)


def read_checkpoint(path: Path) -> Checkpoint | None:
    """Return the content of a checkpoint's file; ``None`` where it is no checkpoint but a map file.

    Raises:
        MapFileError: it is damaged, or needs a newer reader.
        OSError: it cannot be read.
    """
    with closing(FileBytes(path)) as source, named(str(path)):
        return CheckpointIndex(source).checkpoint if is_checkpoint(source) else None


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


class CheckpointIndex:
    """A checkpoint whose parts are read when they are asked for, as those of a map file are."""

    def __init__(self, source: FileBytes) -> None:
        """Read the file, which is closed with this index.

        Raises:
            MapFileError: it is no checkpoint, is damaged, or needs a newer reader.
        """
        self._source = source
        self._parts = PartFiles(Path(source.name).parent)
        begin = len(MAGIC) + DIGEST_BYTES
        if not begin < source.size < MAX_PART_BYTES or not is_checkpoint(source):
            raise DamagedMapFileError(f"it is no checkpoint, or is incomplete: {source.size} bytes")
        frame = source.read(begin, source.size - begin)
        if hashlib.sha256(frame).digest() != source.read(len(MAGIC), DIGEST_BYTES):
            raise DamagedMapFileError("the list of its parts fails its checksum")
        body = unpack_body(MANIFEST, decompress(frame))
        self.manifest = manifest_in(body, source.size)
        self.manifest.check_total(self.manifest.stored_bytes, MAX_CHECKPOINT_BYTES)
        self.checkpoint = _checkpoint(self.manifest, body)
        self.size = source.size + self.manifest.stored_bytes  # bytes, with all parts
        self.metadata = {
            "format_version": f"{version_of(self.manifest.facts)}",
            "producer": body.value("producer", str),
        }
        if self.manifest.stamp_ns:
            self.metadata["created"] = utc_time(self.manifest.stamp_ns)

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def check_unread(self) -> None:
        """Do nothing: readers of the map use all of it."""

    def payload(self, entry: Entry) -> bytes:
        """Return the payload of a part; errors are those of :meth:`PartFiles.payload`.

        Raises:
            MapFileError: the checkpoint was deleted since it was opened, and the part with it.
        """
        try:
            return self._parts.payload(entry)
        except DamagedMapFileError as error:
            if Path(self._source.name).exists():
                raise
            raise MapFileError(
                "the server deleted this checkpoint while it was read: open a newer one"
            ) from error

    def missing(self) -> list[Entry]:
        """Return the parts that are not there, or not in their size."""
        return [entry for entry in self.manifest.entries if not self._parts.has(entry)]


def open_index(source: RandomAccess) -> MapIndex | CheckpointIndex:
    """Return the parts of a map file or, where the source is one, of a checkpoint.

    Raises:
        MapFileError: it is neither, is damaged, or needs a newer reader.
    """
    if isinstance(source, FileBytes) and is_checkpoint(source):
        return CheckpointIndex(source)
    return MapIndex(source)


def is_checkpoint(source: FileBytes) -> bool:
    """Return whether a file begins as checkpoints do."""
    return source.read(0, min(len(MAGIC), source.size)) == MAGIC


def _checkpoint(manifest: Manifest, body: PartBody) -> Checkpoint:
    """Return what is listed besides the parts.

    Raises:
        FormatError: something of it is malformed.
    """
    restored = None
    if body.has("restored"):
        last = PartBody(MANIFEST, body.mapping("restored"))
        restored = Restored(last.count("epoch"), last.count("as_epoch"))
    regions = region_facts_in(body, "regions") if body.has("regions") else None
    if regions is not None and regions.keys() != manifest.regions:
        raise DamagedMapFileError(f"{MANIFEST}: it tells of other regions than it lists")
    return Checkpoint(manifest, body.value("undoes", str), restored, regions)
