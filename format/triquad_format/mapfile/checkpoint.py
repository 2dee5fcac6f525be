"""A checkpoint: a small file that lists the parts of a map at one epoch.

The parts lie next to it, in the folder of :mod:`triquad_format.mapfile.part_files`. The file is one
line that says what it is, the SHA-256 of the rest, and a zstd frame with the manifest.
"""

import hashlib
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import zstandard

from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.container import RandomAccess, decompress
from triquad_format.mapfile.durable_file import replacing
from triquad_format.mapfile.index import FileBytes, MapIndex, named
from triquad_format.mapfile.manifest import (
    DIGEST_BYTES,
    Entry,
    Manifest,
    manifest_in,
    pack_manifest,
)
from triquad_format.mapfile.metadata import FORMAT_VERSION, PRODUCER, utc_time
from triquad_format.mapfile.part_files import PartFiles
from triquad_format.mapfile.parts.body import PartBody, unpack_body
from triquad_format.mapfile.parts.part import MANIFEST, MAX_PART_BYTES
from triquad_format.mapfile.writer import MapFileInfo, check_totals

MAGIC = b"triquad checkpoint\n"

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


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> MapFileInfo:
    """Write a checkpoint whose parts are there, all of it or nothing; return size and digest.

    Raises:
        FormatError: it lists more than it may, or the map is too large to be read.
        OSError: it cannot be written.
    """
    entries = checkpoint.manifest.entries
    check_totals(sum(entry.size for entry in entries), checkpoint.manifest.stored_bytes)
    more: dict[str, object] = {"producer": PRODUCER, "undoes": checkpoint.undoes}
    if checkpoint.restored is not None:
        more["restored"] = vars(checkpoint.restored)
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
        self.manifest.check_total(self.manifest.stored_bytes)
        self.checkpoint = _checkpoint(self.manifest, body)
        self.size = source.size + self.manifest.stored_bytes  # bytes, with all parts
        self.metadata = {
            "format_version": f"{FORMAT_VERSION}",
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
    return Checkpoint(manifest, body.value("undoes", str), restored)
