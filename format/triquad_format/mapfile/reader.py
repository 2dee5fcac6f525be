"""Reading map files whole: nothing of a file is used before it is checked."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from triquad_format.errors import DamagedMapFileError, TooLargeMapFileError
from triquad_format.mapfile.index import OtherFiles, files_in, named, open_regular
from triquad_format.mapfile.manifest import DIGEST_BYTES, Entry, Manifest, unpack_manifest
from triquad_format.mapfile.mcap.reader import McapFile
from triquad_format.mapfile.mcap.records import Message, total_limit
from triquad_format.mapfile.metadata import (
    MAX_MAP_BYTES,
    METADATA_NAME,
    check_agreement,
    check_map_part,
    readable_metadata,
)
from triquad_format.mapfile.parts.part import (
    MANIFEST,
    MAP,
    MAX_PART_BYTES,
    MESSAGE_ENCODING,
    PREFIX,
    PREVIEW,
    REGION,
    REGION_TOPICS,
    TOPICS,
)
from triquad_format.mapfile.parts.region_parts import RegionParts
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.record_check import check_record
from triquad_format.records.region import MapRecord

_BLOCK_BYTES = 1 << 20


@dataclass(frozen=True)
class StoredPart:
    """A part as it lies in the file."""

    topic: str
    stored_size: int  # bytes that it takes in the file, compressed


@dataclass(frozen=True)
class MapFile:
    """A map file that has passed every check."""

    record: MapRecord
    metadata: dict[str, str]  # of the record "triquad"
    parts: tuple[StoredPart, ...]  # of this file, without the manifest
    size: int  # bytes
    manifest: Manifest
    manifest_sha256: bytes  # of the manifest's payload


def read_map(source: Path | str | BinaryIO, *, max_bytes: int = MAX_MAP_BYTES) -> MapRecord:
    """The record in a map file; arguments and errors are those of :func:`read_map_file`."""
    return read_map_file(source, max_bytes=max_bytes).record


def read_map_file(source: Path | str | BinaryIO, *, max_bytes: int = MAX_MAP_BYTES) -> MapFile:
    """Read a map file and check all of it. Arrays may be read-only.

    Args:
        source: a path, or a binary stream, which is read to its end. Parts in other files are
            looked for in the folder of the path.
        max_bytes: limit on the file's size and, decompressed, on its parts together.

    Raises:
        DamagedMapFileError: bytes are missing or altered.
        UnsupportedMapFileError: the file needs a newer reader.
        TooLargeMapFileError: it exceeds ``max_bytes``, or the memory there is.
        MapFileError: it is not a map file.
        OSError: the file cannot be read.
    """
    if isinstance(source, (str, Path)):
        with open_regular(Path(source)) as stream:
            return _read(stream, str(source), max_bytes=max_bytes, folder=Path(source).parent)
    name = str(getattr(source, "name", "map file"))
    return _read(source, name, max_bytes=max_bytes, folder=None)


def _read(stream: BinaryIO, name: str, *, max_bytes: int, folder: Path | None) -> MapFile:
    with named(name):
        # Block by block: one read of the limit's size would reserve all of it.
        data = bytearray()
        while block := stream.read(_BLOCK_BYTES):
            data += block
            if len(data) > max_bytes:
                raise TooLargeMapFileError(f"it is larger than the limit of {max_bytes} bytes")
        return _parse(memoryview(data), min(max_bytes, total_limit(len(data))), folder)


def _parse(data: memoryview, max_bytes: int, folder: Path | None) -> MapFile:
    mcap = McapFile(data)
    found = [entries for name, entries in mcap.metadata if name == METADATA_NAME]
    metadata = readable_metadata(found)
    parts = list(_parts(mcap.messages(max_bytes), len(data) // DIGEST_BYTES))
    if not parts or parts[-1].channel.topic != MANIFEST:
        raise DamagedMapFileError(f"the part {MANIFEST} is missing at the end")
    packed = parts.pop().data
    manifest = unpack_manifest(packed, len(data))
    check_agreement(metadata, manifest.facts, needs_other_files=bool(manifest.files))
    stored = tuple(StoredPart(part.channel.topic, part.stored_bytes) for part in parts)
    record = _record(manifest, parts, folder)
    check_record(record)
    return MapFile(
        record,
        metadata=metadata,
        parts=stored,
        size=len(data),
        manifest=manifest,
        manifest_sha256=hashlib.sha256(packed).digest(),
    )


def _parts(messages: Iterator[Message], most: int) -> Iterator[Message]:
    """The messages that are parts, known or not; a file with more than ``most`` is refused."""
    after = False
    count = 0
    for message in messages:
        topic, encoding = message.channel
        if topic != PREVIEW and not topic.startswith(PREFIX):
            continue
        count += 1
        if count > most:
            raise DamagedMapFileError("it has more parts than its manifest has room to list")
        if after:
            raise DamagedMapFileError(f"the part {topic:.80} follows the manifest")
        after = topic == MANIFEST
        if len(message.data) > MAX_PART_BYTES:
            raise DamagedMapFileError(f"a part {topic:.80} exceeds {MAX_PART_BYTES} bytes")
        if topic in TOPICS and encoding != MESSAGE_ENCODING:
            raise DamagedMapFileError(f"{topic} is encoded in {encoding!r:.40}")
        yield message


def _record(manifest: Manifest, parts: list[Message], folder: Path | None) -> MapRecord:
    """The record of all parts, those in other files included; empties ``parts``."""
    own = manifest.own
    if len(own) != len(parts):
        raise DamagedMapFileError(f"{len(parts)} parts, but its manifest lists {len(own)}")
    payloads: dict[Entry, bytes] = {}
    for number, (entry, part) in enumerate(zip(own, parts, strict=True)):
        entry.check(number, part.channel.topic, part.data)
        payloads[entry] = part.data
    parts.clear()
    others = OtherFiles(None if folder is None else files_in(folder))
    try:
        return assemble(
            manifest, lambda e: payloads.pop(e) if e.file is None else others.payload(e)
        )
    finally:
        others.close()


def assemble(manifest: Manifest, payload_of: Callable[[Entry], bytes]) -> MapRecord:
    """The record of the parts that a manifest lists.

    Args:
        manifest: the list; regions come in the order of their parts ``/triquad/region``.
        payload_of: gives the checked payload of a part; it is asked once for each.

    Raises:
        FormatError: a part is missing, malformed or does not fit the others.
    """
    settings = manifest.facts.settings
    by_region: dict[RegionIndex, list[Entry]] = {}
    for entry in manifest.entries:
        if entry.key.topic == REGION:
            by_region[entry.key.region] = []
    for entry in manifest.entries:
        if entry.key.topic == MAP:
            check_map_part(payload_of(entry), manifest.facts)
        elif entry.key.topic in REGION_TOPICS:
            by_region[entry.key.region].append(entry)
    regions = []
    for index, entries in by_region.items():
        parts = RegionParts(index, settings)
        for entry in entries:
            parts.add(entry.key, payload_of(entry))
        regions.append(parts.region())
    facts = manifest.facts
    return MapRecord(facts.name, facts.epoch, settings, tuple(regions), facts.progress)
