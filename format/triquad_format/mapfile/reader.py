"""Reading map files whole: nothing is believed before it is checked."""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from triquad_format.errors import DamagedMapFileError, TooLargeMapFileError
from triquad_format.mapfile.container import (
    MAX_MAP_BYTES,
    MAX_PART_BYTES,
    MESSAGE_ENCODING,
    METADATA_NAME,
)
from triquad_format.mapfile.file_errors import named
from triquad_format.mapfile.file_metadata import (
    check_agreement,
    check_features,
    check_readable,
    one_metadata,
)
from triquad_format.mapfile.index import OtherFiles, files_in
from triquad_format.mapfile.manifest import DIGEST_BYTES, Entry, Manifest, unpack_manifest
from triquad_format.mapfile.map_facts import MapFacts
from triquad_format.mapfile.mcap.records import McapFile, Message, total_limit
from triquad_format.mapfile.parts.part import MANIFEST, PREFIX, PREVIEW, TOPICS
from triquad_format.mapfile.parts.unpack import assemble
from triquad_format.mapfile.random_access import open_regular
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
    """The record in a map file; see :func:`read_map_file`."""
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
            return _read(str(source), stream, max_bytes, Path(source).parent)
    return _read(str(getattr(source, "name", "map file")), source, max_bytes, None)


def _read(name: str, stream: BinaryIO, max_bytes: int, folder: Path | None) -> MapFile:
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
    metadata = one_metadata([entries for name, entries in mcap.metadata if name == METADATA_NAME])
    check_readable(metadata)
    messages = list(_parts(mcap.messages(max_bytes), len(data) // DIGEST_BYTES))
    if not messages or messages[-1].topic != MANIFEST:
        raise DamagedMapFileError(f"the part {MANIFEST} is missing at the end")
    packed = messages.pop().data
    manifest = unpack_manifest(packed, len(data))
    parts = tuple(StoredPart(message.topic, message.stored_bytes) for message in messages)
    record = _assemble(manifest, messages, folder)
    check_features(metadata, manifest)
    check_agreement(metadata, MapFacts(record.name, record.epoch, record.settings))
    check_record(record)
    return MapFile(record, metadata, parts, len(data), manifest, hashlib.sha256(packed).digest())


def _parts(messages: Iterator[Message], most: int) -> Iterator[Message]:
    """The messages that are parts, known or not; a file with more than ``most`` is refused."""
    after = False
    count = 0
    for message in messages:
        if message.topic != PREVIEW and not message.topic.startswith(PREFIX):
            continue
        count += 1
        if count > most:
            raise DamagedMapFileError("it has more parts than its manifest has room to list")
        if after:
            raise DamagedMapFileError(f"the part {message.topic:.80} follows the manifest")
        after = message.topic == MANIFEST
        if len(message.data) > MAX_PART_BYTES:
            raise DamagedMapFileError(f"a part {message.topic:.80} exceeds {MAX_PART_BYTES} bytes")
        if message.topic in TOPICS and message.encoding != MESSAGE_ENCODING:
            raise DamagedMapFileError(f"{message.topic} is encoded in {message.encoding!r:.40}")
        yield message


def _assemble(manifest: Manifest, messages: list[Message], folder: Path | None) -> MapRecord:
    """The record of all parts, those in other files included; empties ``messages``."""
    own = manifest.own
    if len(own) != len(messages):
        raise DamagedMapFileError(f"{len(messages)} parts, but its manifest lists {len(own)}")
    payloads: dict[Entry, bytes] = {}
    for number, (entry, message) in enumerate(zip(own, messages, strict=True)):
        entry.check(number, message.topic, message.data)
        payloads[entry] = message.data
    messages.clear()
    others = OtherFiles(None if folder is None else files_in(folder))
    try:
        return assemble(
            manifest, lambda e: payloads.pop(e) if e.file is None else others.payload(e)
        )
    finally:
        others.close()
