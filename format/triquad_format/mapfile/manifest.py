"""The manifest: the list of all parts of a map at one epoch."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError, FormatError, TooLargeMapFileError
from triquad_format.mapfile.metadata import MAX_MAP_BYTES, pack_facts, unpack_facts
from triquad_format.mapfile.parts.body import PartBody
from triquad_format.mapfile.parts.pack import pack_part
from triquad_format.mapfile.parts.part import (
    MANIFEST,
    MAP,
    MAX_PART_BYTES,
    REGION,
    REGION_TOPICS,
    TRAINING,
    Part,
    PartKey,
)
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord
from triquad_format.wire.packing import pack_array

MAX_ENTRIES = 1 << 20
DIGEST_BYTES = 32
"""Bytes of a SHA-256."""

_COLUMNS = {
    "topic": ("|u1", ()),
    "region": ("<i4", (3,)),
    "plane": ("|u1", ()),
    "cell": ("<i8", ()),
    "bytes": ("<i8", ()),
    "sha256": ("|u1", (DIGEST_BYTES,)),
    "epoch": ("<i8", ()),
    "offset": ("<i8", ()),
    "stored": ("<i8", ()),
}

_FREE_TOTAL_BYTES = 32 * 2**20
_MAX_TOTAL_RATIO = 32
"""The parts of a file, decompressed, have at most this multiple of its size, and that more."""


@dataclass(frozen=True)
class Entry:
    """A part as the manifest lists it."""

    key: PartKey
    size: int  # bytes of its payload
    sha256: bytes  # of its payload
    epoch: int  # in which it last changed
    offset: int = 0  # where its chunk record begins in a map file, bytes; 0 in a checkpoint
    stored: int = 0  # bytes of that record and of the message index after it, or of the part's file

    def check(self, data: bytes) -> None:
        """Raise :class:`DamagedMapFileError` unless ``data`` is the payload of this part."""
        if len(data) != self.size or hashlib.sha256(data).digest() != self.sha256:
            raise DamagedMapFileError(f"what lies at byte {self.offset} is not the part listed")

    @property
    def name(self) -> str:
        """Return the digest as text, which is the name of the part's file in a store."""
        return self.sha256.hex()


@dataclass(frozen=True)
class Manifest:
    """All parts of a map at one epoch."""

    facts: MapRecord  # without its regions
    stamp_ns: int  # when the epoch was written, nanoseconds since 1970; 0 if not known
    entries: tuple[Entry, ...]  # in the order of the file

    @property
    def stored_bytes(self) -> int:
        """Return the bytes that all parts take where they are stored."""
        return sum(entry.stored for entry in self.entries)

    @property
    def regions(self) -> frozenset[RegionIndex]:
        """The regions of the map."""
        return frozenset(entry.key.region for entry in self.entries if entry.key.topic == REGION)

    def of_regions(self) -> dict[RegionIndex, list[Entry]]:
        """Return the parts of each region, in the order of the parts :data:`REGION`."""
        parts: dict[RegionIndex, list[Entry]] = {
            entry.key.region: [] for entry in self.entries if entry.key.topic == REGION
        }
        for entry in self.entries:
            if entry.key.topic in REGION_TOPICS:
                parts[entry.key.region].append(entry)
        return parts

    def check_total(self, stored_bytes: int, most: int | None = None) -> None:
        """Refuse parts that unpack to more than ``most``, or to too much for so few stored bytes.

        ``None``: what a map file may have.

        Raises:
            TooLargeMapFileError, DamagedMapFileError: they do.
        """
        most = MAX_MAP_BYTES if most is None else most
        total = sum(entry.size for entry in self.entries)
        if max(total, stored_bytes) > most:
            raise TooLargeMapFileError(f"it exceeds the limit of {most} bytes")
        if total > total_limit(stored_bytes):
            raise DamagedMapFileError(
                f"{MANIFEST}: parts of {total} bytes in a file of {stored_bytes}"
            )


_NOTHING: Mapping[str, object] = MappingProxyType({})


def pack_manifest(manifest: Manifest, more: Mapping[str, object] = _NOTHING) -> Part:
    """Return the manifest as the last part of its file, with ``more`` fields.

    Raises:
        FormatError: it lists more than a manifest may.
    """
    entries = manifest.entries
    if len(entries) > MAX_ENTRIES:
        raise FormatError(f"{len(entries)} parts; a manifest lists at most {MAX_ENTRIES}")
    topics = sorted({entry.key.topic for entry in entries})
    columns: dict[str, Any] = {
        "topic": [topics.index(entry.key.topic) for entry in entries],
        "region": [entry.key.region for entry in entries],
        "plane": [entry.key.plane for entry in entries],
        "cell": [entry.key.cell for entry in entries],
        "bytes": [entry.size for entry in entries],
        "sha256": [np.frombuffer(entry.sha256, np.uint8) for entry in entries],
        "epoch": [entry.epoch for entry in entries],
        "offset": [entry.offset for entry in entries],
        "stored": [entry.stored for entry in entries],
    }
    parts = {
        name: pack_array(np.array(columns[name], dtype).reshape(-1, *row))
        for name, (dtype, row) in _COLUMNS.items()
    }
    own = {"created_ns": manifest.stamp_ns, "topics": topics, "parts": parts}
    return pack_part(PartKey(MANIFEST), {**pack_facts(manifest.facts), **own, **more})


def manifest_in(body: PartBody, file_bytes: int) -> Manifest:
    """Return the manifest in the body of a part.

    Args:
        body: that of the part ``/triquad/manifest``.
        file_bytes: size of its file, which bounds how many parts it can list.

    Raises:
        FormatError: it is malformed, lists a part twice, or parts of a region that it lacks.
    """
    facts = unpack_facts(body)
    topics = body.texts("topics")
    packed = PartBody(MANIFEST, body.mapping("parts"))
    columns = {
        name: packed.array(name, dtype, (None, *row)) for name, (dtype, row) in _COLUMNS.items()
    }
    count = len(columns["topic"])
    # Digests cannot be compressed: where the file has no room for them, they are not digests.
    most = min(MAX_ENTRIES, file_bytes // DIGEST_BYTES)
    if any(len(column) != count for column in columns.values()) or count > most:
        raise DamagedMapFileError(f"{MANIFEST}: its columns differ in length, or are too long")
    _check_columns(columns, len(topics))
    entries = tuple(_entries(columns, topics))
    if len({entry.key for entry in entries}) != count:
        raise DamagedMapFileError(f"{MANIFEST}: it lists a part twice")
    _check_keys([entry.key for entry in entries])
    return Manifest(facts, body.count("created_ns"), entries)


def _check_columns(columns: Mapping[str, NDArray[Any]], topics: int) -> None:
    limits = {"topic": topics, "plane": 3, "bytes": MAX_PART_BYTES + 1}
    for name, limit in limits.items():
        if (columns[name] >= limit).any():
            raise DamagedMapFileError(f"{MANIFEST}: a number in {name!r} is out of range")
    for name in ("cell", "bytes", "epoch", "offset", "stored"):
        if (columns[name] < 0).any():
            raise DamagedMapFileError(f"{MANIFEST}: a number in {name!r} is negative")


def _check_keys(keys: list[PartKey]) -> None:
    """Refuse parts of a region whose head is not listed, and cells of what has none."""
    for key in keys:
        if key.topic in (MAP, REGION, TRAINING) and (key.plane or key.cell):
            raise DamagedMapFileError(f"{MANIFEST}: {key.topic} has plane or cell: {key}")
    regions = {key.region for key in keys if key.topic == REGION}
    for key in keys:
        if key.topic in REGION_TOPICS and key.region not in regions:
            raise DamagedMapFileError(f"the part {REGION} of {key.region} is missing")


def total_limit(file_bytes: int) -> int:
    """Return the bytes to which all parts of a file of ``file_bytes`` may decompress together."""
    return _FREE_TOTAL_BYTES + _MAX_TOTAL_RATIO * file_bytes


def _entries(columns: Mapping[str, NDArray[Any]], topics: list[str]) -> Iterable[Entry]:
    digests = [digest.tobytes() for digest in columns["sha256"]]
    others = [columns[name].tolist() for name in _COLUMNS if name != "sha256"]
    for digest, row in zip(digests, zip(*others, strict=True), strict=True):
        topic, region, plane, cell, size, epoch, offset, stored = row
        yield Entry(
            PartKey(topics[topic], tuple(region), plane=plane, cell=cell),
            size=size,
            sha256=digest,
            epoch=epoch,
            offset=offset,
            stored=stored,
        )
