"""Writing map files: the same record gives the same bytes, and a path gets all of them or none."""

import contextlib
import hashlib
import os
import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from triquad_format import __version__
from triquad_format.errors import FormatError
from triquad_format.map_parts import (
    FEATURE_DTYPES,
    FRAME_ID,
    UNITS,
    Part,
    pack_manifest,
    pack_record,
)
from triquad_format.mcap_records import MAX_CHUNK_BYTES
from triquad_format.record_check import check_record
from triquad_format.region import MapRecord

FORMAT_VERSION = 1
MIN_READER_VERSION = 1
METADATA_NAME = "triquad"
MESSAGE_ENCODING = "msgpack"
MAX_PART_BYTES = MAX_CHUNK_BYTES - 65_536

MAX_MAP_BYTES = 4 * 2**30
"""Limit on the size of a map file, and on its chunks' decompressed size together."""

_MCAP_BYTES = 256
"""What MCAP adds to a part within its chunk takes less."""


@dataclass(frozen=True)
class MapFileInfo:
    """What was written."""

    bytes: int
    sha256: str  # of the whole file, hexadecimal
    epoch: int


def write_map(
    record: MapRecord,
    file: BinaryIO | Path | str,
    *,
    feature_dtype: str = "<f2",
    stamp_ns: int | None = None,
) -> MapFileInfo:
    """Write a map file.

    A path is written under a temporary name (``.<name>.<random>.tmp``) in the same folder, synced
    and renamed, so that the final name never holds half a file.

    Args:
        record: the map; it is checked first.
        file: a path, or a binary stream at the place where the file begins.
        feature_dtype: ``"<f2"`` or ``"<f4"``, the precision of the vertex features.
        stamp_ns: time of creation, nanoseconds since 1970; left out, the file holds no time.

    Raises:
        FormatError: the record is not sound, or exceeds a limit of the format.
        OSError: the file cannot be written.
    """
    if feature_dtype not in FEATURE_DTYPES:
        raise FormatError(f"feature_dtype = {feature_dtype!r} is not one of {FEATURE_DTYPES}")
    if stamp_ns is not None and not 0 <= stamp_ns < 2**63:
        raise FormatError(f"stamp_ns = {stamp_ns} is out of range")
    check_record(record)
    if isinstance(file, (str, Path)):
        with _replacing(Path(file)) as stream:
            return _write(record, stream, feature_dtype, stamp_ns)
    return _write(record, file, feature_dtype, stamp_ns)


class _MeasuredStream:
    """Passes bytes on, counting and digesting them; all that the MCAP writer needs of a file."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._count = 0
        self._digest = hashlib.sha256()

    def write(self, data: bytes) -> int:
        self._stream.write(data)
        self._count += len(data)
        self._digest.update(data)
        return len(data)

    def tell(self) -> int:
        return self._count

    def info(self, epoch: int) -> MapFileInfo:
        return MapFileInfo(self._count, self._digest.hexdigest(), epoch)


def _write(
    record: MapRecord, stream: BinaryIO, feature_dtype: str, stamp_ns: int | None
) -> MapFileInfo:
    measured = _MeasuredStream(stream)
    # A chunk closes as soon as it exceeds this size: every part gets a chunk of its own.
    writer = Writer(
        measured,  # type: ignore[arg-type]
        chunk_size=1,
        compression=CompressionType.ZSTD,
        enable_crcs=True,
        enable_data_crcs=True,
    )
    writer.start(profile="", library=f"triquad {__version__}")
    writer.add_metadata(METADATA_NAME, _metadata(record, stamp_ns))
    channels: dict[str, int] = {}
    total = 0
    for sequence, part in enumerate(_parts(record, feature_dtype)):
        if len(part.payload) > MAX_PART_BYTES:
            raise FormatError(
                f"the part {part.topic} has {len(part.payload)} bytes; "
                f"a map file holds parts of at most {MAX_PART_BYTES}",
            )
        total += len(part.payload) + _MCAP_BYTES
        _check_total(total)
        if part.topic not in channels:
            channels[part.topic] = writer.register_channel(part.topic, MESSAGE_ENCODING, 0)
        time = stamp_ns or 0
        writer.add_message(channels[part.topic], time, part.payload, time, sequence)
    writer.finish()  # type: ignore[no-untyped-call]
    _check_total(measured.tell())
    return measured.info(record.epoch)


def _check_total(size: int) -> None:
    if size > MAX_MAP_BYTES:
        raise FormatError(
            f"the map takes {size} bytes or more; a map file holds at most {MAX_MAP_BYTES}",
        )


def _parts(record: MapRecord, feature_dtype: str) -> Iterator[Part]:
    """All parts of the file, the manifest last."""
    entries: list[tuple[str, int, bytes]] = []
    for part in pack_record(record, feature_dtype):
        entries.append((part.topic, len(part.payload), hashlib.sha256(part.payload).digest()))
        yield part
    yield pack_manifest(entries)


def _metadata(record: MapRecord, stamp_ns: int | None) -> dict[str, str]:
    entries = {
        "format_version": str(FORMAT_VERSION),
        "min_reader_version": str(MIN_READER_VERSION),
        "required_features": "",
        "producer": f"triquad {__version__}",
        "map": record.name,
        "epoch": str(record.epoch),
        "frame_id": FRAME_ID,
        "units": UNITS,
    }
    if stamp_ns is not None:
        created = datetime.fromtimestamp(stamp_ns // 10**9, timezone.utc)
        entries["created"] = created.strftime("%Y-%m-%dT%H:%M:%SZ")
    return entries


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """A stream whose bytes replace the file at ``path``, durably, where nothing is raised."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make a rename durable, where the system lets folders be synced."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
