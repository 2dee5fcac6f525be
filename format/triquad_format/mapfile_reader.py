"""Reading map files: nothing is believed before it is checked."""

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.map_parts import FRAME_ID, MANIFEST, PREFIX, TOPICS, UNITS, Part
from triquad_format.mapfile_writer import (
    FORMAT_VERSION,
    MAX_MAP_BYTES,
    MAX_PART_BYTES,
    MESSAGE_ENCODING,
    METADATA_NAME,
)
from triquad_format.mcap_records import McapFile, Message
from triquad_format.part_reader import PartCursor, unpack_manifest, unpack_record
from triquad_format.record_check import check_record
from triquad_format.region import MapRecord

KNOWN_FEATURES: frozenset[str] = frozenset()
"""The ``required_features`` that this reader understands."""

_BLOCK_BYTES = 1 << 20

REMEDY = "an older checkpoint beside it may be intact"


@dataclass(frozen=True)
class StoredPart:
    """A part as it lies in the file."""

    topic: str
    size: int  # bytes of its msgpack map
    stored_size: int  # bytes that it takes in the file, compressed
    sha256: bytes


@dataclass(frozen=True)
class MapFile:
    """A map file that has passed every check."""

    record: MapRecord
    metadata: dict[str, str]  # of the record "triquad"
    parts: tuple[StoredPart, ...]  # without the manifest
    size: int  # bytes


def read_map(source: Path | str | BinaryIO, *, max_bytes: int = MAX_MAP_BYTES) -> MapRecord:
    """The record in a map file; see :func:`read_map_file`."""
    return read_map_file(source, max_bytes=max_bytes).record


def read_map_file(source: Path | str | BinaryIO, *, max_bytes: int = MAX_MAP_BYTES) -> MapFile:
    """Read a map file and check all of it. Arrays may be read-only.

    Args:
        source: a path, or a binary stream, which is read to its end.
        max_bytes: limit on the file's size and, decompressed, on its parts together.

    Raises:
        DamagedMapFileError: bytes are missing or altered.
        UnsupportedMapFileError: the file needs a newer reader.
        TooLargeMapFileError: it exceeds ``max_bytes``, or the memory there is.
        MapFileError: it is not a map file.
        OSError: the file cannot be read.
    """
    if isinstance(source, (str, Path)):
        with Path(source).open("rb") as stream:
            return _read(str(source), stream, max_bytes)
    return _read(str(getattr(source, "name", "map file")), source, max_bytes)


def _read(name: str, stream: BinaryIO, max_bytes: int) -> MapFile:
    with _named(name):
        # Block by block: one read of the limit's size would reserve all of it.
        data = bytearray()
        while block := stream.read(_BLOCK_BYTES):
            data += block
            if len(data) > max_bytes:
                raise TooLargeMapFileError(f"it is larger than the limit of {max_bytes} bytes")
        return _parse(memoryview(data), max_bytes)


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Put the file's name and, for damage, the remedy into what is raised."""
    try:
        yield
    except (UnsupportedMapFileError, TooLargeMapFileError) as error:
        raise type(error)(f"{name}: {error}") from error
    except DamagedMapFileError as error:
        raise DamagedMapFileError(f"{name} is damaged: {error}; {REMEDY}") from error
    except MapFileError as error:
        raise MapFileError(f"{name}: {error}") from error
    except FormatError as error:
        raise DamagedMapFileError(f"{name} is damaged: {error}; {REMEDY}") from error
    except MemoryError as error:
        raise TooLargeMapFileError(f"{name}: the map does not fit into memory") from error


def _parse(data: memoryview, max_bytes: int) -> MapFile:
    mcap = McapFile(data)
    metadata = _find_metadata(mcap.metadata)
    _check_versions(metadata)
    passed: list[StoredPart] = []
    cursor = PartCursor(_known_parts(mcap.messages(max_bytes), passed))
    record = unpack_record(cursor)
    before = len(passed)
    listed = unpack_manifest(cursor, before)
    cursor.finish()
    _check_manifest(listed, passed)
    _check_agreement(metadata, record)
    check_record(record)
    return MapFile(record, metadata, tuple(passed[:-1]), len(data))


def _find_metadata(records: list[tuple[str, dict[str, str]]]) -> dict[str, str]:
    found = [entries for name, entries in records if name == METADATA_NAME]
    if not found:
        raise MapFileError("this is an MCAP file, but not a map: it has no metadata 'triquad'")
    if len(found) > 1:
        raise DamagedMapFileError("the metadata 'triquad' is there more than once")
    return found[0]


def _check_versions(metadata: dict[str, str]) -> None:
    needed = metadata.get("min_reader_version", "")
    # int() alone would also take '+1', ' 1' and digits of other scripts, of any length.
    if not (needed.isascii() and needed.isdigit() and len(needed) < 10):
        raise DamagedMapFileError(f"min_reader_version = {needed!r:.40} is not a number")
    if int(needed) > FORMAT_VERSION:
        raise UnsupportedMapFileError(
            f"it needs a reader of map file version {needed}; this one reads {FORMAT_VERSION}: "
            f"install a newer triquad (written by {metadata.get('producer', 'unknown')!r:.80})",
        )
    if "required_features" not in metadata:
        raise DamagedMapFileError("the metadata 'triquad' does not name its required_features")
    required = {name.strip() for name in metadata["required_features"].split(",")} - {""}
    if required - KNOWN_FEATURES:
        unknown = ", ".join(sorted(required - KNOWN_FEATURES))
        raise UnsupportedMapFileError(
            f"it requires {unknown:.200}, which this reader does not know: install a newer triquad"
        )


def _known_parts(messages: Iterator[Message], passed: list[StoredPart]) -> Iterator[Part]:
    """The parts that this version reads; every part, known or not, is noted in ``passed``."""
    for message in messages:
        if not message.topic.startswith(PREFIX):
            continue
        if len(message.data) > MAX_PART_BYTES:
            raise DamagedMapFileError(f"a part {message.topic:.80} exceeds {MAX_PART_BYTES} bytes")
        digest = hashlib.sha256(message.data).digest()
        passed.append(StoredPart(message.topic, len(message.data), message.stored_bytes, digest))
        if passed[:-1] and passed[-2].topic == MANIFEST:
            raise DamagedMapFileError(f"the part {message.topic:.80} follows the manifest")
        if message.topic not in TOPICS:
            continue
        if message.encoding != MESSAGE_ENCODING:
            raise DamagedMapFileError(f"{message.topic} is encoded in {message.encoding!r:.40}")
        yield Part(message.topic, message.data)


def _check_manifest(listed: list[tuple[str, int, bytes]], passed: list[StoredPart]) -> None:
    found = [(part.topic, part.size, part.sha256) for part in passed[:-1]]
    for number, (have, want) in enumerate(zip(found, listed, strict=False)):
        if have != want:
            raise DamagedMapFileError(
                f"part {number}, {have[0]:.80}, is not the one that the manifest lists there",
            )
    if len(found) != len(listed):
        raise DamagedMapFileError(f"{len(found)} parts, but its manifest lists {len(listed)}")


def _check_agreement(metadata: dict[str, str], record: MapRecord) -> None:
    wanted = {
        "map": record.name,
        "epoch": str(record.epoch),
        "frame_id": FRAME_ID,
        "units": UNITS,
    }
    for key, value in wanted.items():
        if metadata.get(key) != value:
            raise DamagedMapFileError(
                f"its metadata says {key} = {metadata.get(key)!r:.80}, its parts say {value!r}",
            )
