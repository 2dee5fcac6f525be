"""Writing map files: the same record gives the same bytes, and a path gets all of them or none."""

import contextlib
import hashlib
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

from mcap.records import Channel, Schema

from triquad_format.errors import FormatError
from triquad_format.mapfile.manifest import Entry, Manifest, pack_manifest
from triquad_format.mapfile.mcap.records import total_limit
from triquad_format.mapfile.mcap.writer import McapWriter
from triquad_format.mapfile.metadata import (
    MAX_MAP_BYTES,
    METADATA_NAME,
    MapFacts,
    pack_facts,
    pack_metadata,
)
from triquad_format.mapfile.parts.pack import pack_part, pack_record, seams
from triquad_format.mapfile.parts.part import (
    ENCODINGS,
    EVIDENCE,
    MANIFEST,
    MAP,
    MAX_PART_BYTES,
    MOMENTS,
    PREVIEW,
    PREVIEW_ENCODING,
    PREVIEW_SCHEMA,
    RAYS,
    REGION,
    SAMPLES,
    TRAINING,
    VERTICES,
    Part,
    PartKey,
)
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.record_check import check_record
from triquad_format.records.region import FLOATS, MapRecord

# Levels of zstd: features and moments are noise but for their high bytes, on which level 1 is as
# good as level 19 and better than level 3; masks and codes shrink by a fifth to level 12.
_LEVELS = {
    MAP: 3,
    REGION: 3,
    VERTICES: 1,
    EVIDENCE: 12,
    TRAINING: 1,
    MOMENTS: 1,
    SAMPLES: 1,
    RAYS: 1,
    PREVIEW: 19,
    MANIFEST: 3,
}
_PREVIEW_SCHEMA_ID = 1
_CHANNELS = {
    topic: Channel(
        id=number,
        topic=topic,
        message_encoding=encoding,
        metadata={},
        schema_id=_PREVIEW_SCHEMA_ID if topic == PREVIEW else 0,
    )
    for number, (topic, encoding) in enumerate(ENCODINGS.items(), start=1)
}


@dataclass(frozen=True)
class Previews:
    """What MCAP viewers show of a map. Map files carry it as it is handed in."""

    schema: bytes  # of foxglove.SceneUpdate, a FileDescriptorSet
    parts: Mapping[RegionIndex, Part]  # of the topic PREVIEW


@dataclass(frozen=True)
class MapFileInfo:
    """Size, digest and epoch of a map file that was written."""

    bytes: int  # size of the file
    sha256: str  # of the whole file, hexadecimal
    epoch: int


@dataclass(frozen=True)
class WrittenMap:
    """A file that was written, and what its manifest lists."""

    info: MapFileInfo
    manifest: Manifest
    manifest_sha256: bytes  # of the manifest's payload


def write_map(
    record: MapRecord,
    file: BinaryIO | Path | str,
    *,
    feature_dtype: str = "<f2",
    stamp_ns: int | None = None,
    previews: Previews | None = None,
) -> MapFileInfo:
    """Write a map file that needs no other.

    A path is written under a temporary name (``.<name>.<random>.tmp``) in the same folder, synced
    and renamed, so that the final name never holds half a file.

    Args:
        record: the map; it is checked first.
        file: a path, or a binary stream at the place where the file begins.
        feature_dtype: ``"<f2"`` or ``"<f4"``, the precision of features that are not int8.
        stamp_ns: time of creation, nanoseconds since 1970; left out, the file holds no time.
        previews: what MCAP viewers are to show; left out, the file holds nothing of the kind.

    Raises:
        FormatError: the record is not valid, or exceeds a limit of the format.
        OSError: the file cannot be written.
    """
    if feature_dtype not in FLOATS:
        raise FormatError(f"feature_dtype = {feature_dtype!r} is not one of {FLOATS}")
    if stamp_ns is not None and not 0 <= stamp_ns < 2**63:
        raise FormatError(f"stamp_ns = {stamp_ns} is out of range: use 0 to 2**63 - 1")
    check_record(record)
    facts = MapFacts.of(record)
    parts = pack_record(record, feature_dtype, {} if previews is None else previews.parts)
    schema = None if previews is None else previews.schema
    return write_parts(file, facts, parts, stamp_ns=stamp_ns, preview_schema=schema).info


def write_parts(
    file: BinaryIO | Path | str,
    facts: MapFacts,
    parts: Iterable[Part | Entry],
    *,
    stamp_ns: int | None = None,
    known: Mapping[PartKey, Entry] = MappingProxyType({}),
    preview_schema: bytes | None = None,
) -> WrittenMap:
    """Write a map file from parts.

    Args:
        file: as in :func:`write_map`.
        facts: what the file says of the whole map.
        parts: what the map consists of. An entry stands for a part that lies in another file,
            and is one of ``known``.
        stamp_ns: time of its epoch, nanoseconds since 1970; left out, the file holds no time.
        known: parts of earlier epochs: an equal one keeps its epoch and time, and is not stored
            again where the entry names a file.
        preview_schema: that of :class:`Previews`; needed where there are previews among ``parts``.

    Raises:
        FormatError: a limit of the format is exceeded, or there are previews without their schema.
        OSError: the file cannot be written.
    """
    # Where parts of other files are known, some of them are nearly always needed.
    needs_others = any(entry.file is not None for entry in known.values())
    metadata = pack_metadata(facts, stamp_ns=stamp_ns, needs_other_files=needs_others)
    opened = (
        replacing(Path(file)) if isinstance(file, (str, Path)) else contextlib.nullcontext(file)
    )
    with opened as stream:
        mcap = _mcap_writer(stream, metadata["producer"], preview_schema)
        mcap.add_metadata(METADATA_NAME, metadata)
        return _PartsWriter(mcap, facts, stamp_ns=stamp_ns, known=known).write(parts)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A stream whose bytes replace the file at ``path``, durably, where nothing is raised.

    Raises:
        OSError: the file cannot be written; it is named, and the one that was there stays.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename is None:
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
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


def _mcap_writer(file: BinaryIO, producer: str, preview_schema: bytes | None) -> McapWriter:
    """A writer for a file's messages: previews are described where their schema is given."""
    unused = {RAYS} if preview_schema is not None else {RAYS, PREVIEW}
    channels = [channel for topic, channel in _CHANNELS.items() if topic not in unused]
    schemas = []
    if preview_schema is not None:
        schemas = [Schema(_PREVIEW_SCHEMA_ID, preview_schema, PREVIEW_ENCODING, PREVIEW_SCHEMA)]
    return McapWriter(file, producer, schemas=schemas, channels=channels)


class _PartsWriter:
    """Writes the parts of one file, and keeps what its manifest is to list."""

    def __init__(
        self,
        mcap: McapWriter,
        facts: MapFacts,
        *,
        stamp_ns: int | None,
        known: Mapping[PartKey, Entry],
    ) -> None:
        self._mcap = mcap
        self._facts = facts
        self._stamp_ns = stamp_ns or 0
        self._known = known
        self._entries: list[Entry] = []
        self._total = 0

    def write(self, parts: Iterable[Part | Entry]) -> WrittenMap:
        whole = pack_part(PartKey(MAP), pack_facts(self._facts))
        self._put(whole, self._stamp_ns)
        self._entries.append(self._changed(whole))
        for part in parts:
            if isinstance(part, Entry):
                self._entries.append(part)
            else:
                self._add(part)
        manifest = Manifest(self._facts, self._stamp_ns, tuple(self._entries))
        packed = pack_manifest(manifest)
        self._put(packed, self._stamp_ns)
        self._mcap.finish()
        _check_total(self._mcap.size)
        if self._total > total_limit(self._mcap.size):
            raise FormatError(
                f"the map's parts shrink from {self._total} to {self._mcap.size} bytes: "
                "readers take that for an attack"
            )
        info = MapFileInfo(self._mcap.size, self._mcap.sha256, self._facts.epoch)
        return WrittenMap(info, manifest, hashlib.sha256(packed.payload).digest())

    def _add(self, part: Part) -> None:
        """List a part; store it unless another file has it."""
        entry = self._changed(part)
        known = self._known.get(part.key)
        if known is not None and known.sha256 == entry.sha256:
            entry = known
        if entry.file is None:
            self._put(part, entry.stamp_ns)
        self._entries.append(entry)

    def _changed(self, part: Part) -> Entry:
        """The entry of a part that this epoch changed."""
        return Entry(
            part.key,
            size=len(part.payload),
            sha256=hashlib.sha256(part.payload).digest(),
            epoch=self._facts.epoch,
            stamp_ns=self._stamp_ns,
        )

    def _put(self, part: Part, stamp_ns: int) -> None:
        topic = part.key.topic
        if topic == RAYS and topic not in self._mcap.topics:
            self._mcap.add_channel(_CHANNELS[topic])
        if topic not in self._mcap.topics:
            raise FormatError(
                f"the file has no channel for {part.key}; for previews give preview_schema as well"
            )
        if len(part.payload) > MAX_PART_BYTES:
            raise FormatError(
                f"the part {topic} has {len(part.payload)} bytes; "
                f"a map file holds parts of at most {MAX_PART_BYTES}",
            )
        self._total += len(part.payload)
        _check_total(self._total)
        self._mcap.add_message(
            topic, part.payload, time_ns=stamp_ns, level=_LEVELS[topic], seams=seams(part)
        )


def _check_total(size: int) -> None:
    if size > MAX_MAP_BYTES:
        raise FormatError(
            f"the map takes {size} bytes or more; a map file holds at most {MAX_MAP_BYTES}",
        )
