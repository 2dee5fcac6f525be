"""The manifest: the list of all parts of a map, and the files that contain them."""

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError, FormatError
from triquad_format.mapfile.metadata import MapFacts, pack_facts, unpack_facts
from triquad_format.mapfile.parts.body import PartBody, unpack_body
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
from triquad_format.wire.codec import pack_array

MAX_ENTRIES = 1 << 20
MAX_FILES = 4096
DIGEST_BYTES = 32
"""Bytes of a SHA-256."""

_MAX_FILE_NAME = 255
_COLUMNS = {
    "topic": ("|u1", ()),
    "region": ("<i4", (3,)),
    "plane": ("|u1", ()),
    "cell": ("<i8", ()),
    "bytes": ("<i8", ()),
    "sha256": ("|u1", (DIGEST_BYTES,)),
    "epoch": ("<i8", ()),
    "stamp_ns": ("<i8", ()),
    "file": ("<u2", ()),
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
    stamp_ns: int  # time of that epoch, nanoseconds since 1970; 0 if not known
    file: str | None = None  # name of the file of the same folder that contains it; None: this one
    offset: int = 0  # where its chunk record begins in that file, bytes
    stored: int = 0  # bytes of that record, and of the message index after it

    def check(self, data: bytes) -> None:
        """Raise :class:`DamagedMapFileError` unless ``data`` is the payload of this part."""
        if len(data) != self.size or hashlib.sha256(data).digest() != self.sha256:
            raise DamagedMapFileError(f"what lies at byte {self.offset} is not the part listed")


@dataclass(frozen=True)
class Manifest:
    """All parts of a map at one epoch."""

    facts: MapFacts
    stamp_ns: int  # when the epoch was written, nanoseconds since 1970; 0 if not known
    entries: tuple[Entry, ...]  # those of this file in the order of the file

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the other files that are needed."""
        return tuple(dict.fromkeys(e.file for e in self.entries if e.file is not None))

    @property
    def own(self) -> tuple[Entry, ...]:
        """The parts in the manifest's own file, in their order."""
        return tuple(entry for entry in self.entries if entry.file is None)

    def elsewhere(self, own: str) -> dict[PartKey, Entry]:
        """Return the parts as another file lists them; ``own`` names the manifest's own file."""
        return {e.key: dataclasses.replace(e, file=e.file or own) for e in self.entries}


def pack_manifest(manifest: Manifest) -> Part:
    """Return the manifest as the last part of its file.

    Raises:
        FormatError: it lists more than a manifest may.
    """
    entries = manifest.entries
    files = manifest.files
    if len(entries) > MAX_ENTRIES or len(files) > MAX_FILES:
        raise FormatError(
            f"{len(entries)} parts in {len(files)} other files; a manifest lists at most "
            f"{MAX_ENTRIES} in {MAX_FILES}"
        )
    topics = sorted({entry.key.topic for entry in entries})
    numbers: dict[str | None, int] = {None: 0, **{f: i + 1 for i, f in enumerate(files)}}
    columns: dict[str, Any] = {
        "topic": [topics.index(entry.key.topic) for entry in entries],
        "region": [entry.key.region for entry in entries],
        "plane": [entry.key.plane for entry in entries],
        "cell": [entry.key.cell for entry in entries],
        "bytes": [entry.size for entry in entries],
        "sha256": [np.frombuffer(entry.sha256, np.uint8) for entry in entries],
        "epoch": [entry.epoch for entry in entries],
        "stamp_ns": [entry.stamp_ns for entry in entries],
        "file": [numbers[entry.file] for entry in entries],
        "offset": [entry.offset for entry in entries],
        "stored": [entry.stored for entry in entries],
    }
    body: dict[str, object] = {
        **pack_facts(manifest.facts),
        "created_ns": manifest.stamp_ns,
        "files": list(files),
        "topics": topics,
        "parts": {
            name: pack_array(np.array(columns[name], dtype).reshape(-1, *row))
            for name, (dtype, row) in _COLUMNS.items()
        },
    }
    return pack_part(PartKey(MANIFEST), body)


def unpack_manifest(payload: bytes, file_bytes: int) -> Manifest:
    """Return the manifest in a payload.

    Args:
        payload: that of the part ``/triquad/manifest``.
        file_bytes: size of its file, which bounds how many parts it can list.

    Raises:
        FormatError: it is malformed, lists a part twice, or parts of a region that it lacks.
    """
    body = unpack_body(MANIFEST, payload, max_items=MAX_FILES)
    facts = unpack_facts(body)
    files = [None, *_files(body.texts("files"))]
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
    _check_columns(columns, len(topics), len(files))
    entries = tuple(_entries(columns, topics, files))
    if len({entry.key for entry in entries}) != count:
        raise DamagedMapFileError(f"{MANIFEST}: it lists a part twice")
    _check_keys([entry.key for entry in entries])
    _check_sizes(entries, file_bytes)
    return Manifest(facts, body.count("created_ns"), entries)


def _files(names: list[str]) -> list[str]:
    for name in names:
        # A name, not a path: a manifest must not lead a reader to other folders.
        if name in ("", ".", "..") or len(name) > _MAX_FILE_NAME or set(name) & set("/\\\0"):
            raise DamagedMapFileError(f"{MANIFEST}: {name!r:.80} is not the name of a file")
    if len(set(names)) != len(names):
        raise DamagedMapFileError(f"{MANIFEST}: it names a file twice")
    return names


def _check_columns(columns: Mapping[str, NDArray[Any]], topics: int, files: int) -> None:
    limits = {"topic": topics, "file": files, "plane": 3}
    for name, limit in limits.items():
        if (columns[name] >= limit).any():
            raise DamagedMapFileError(f"{MANIFEST}: a number in {name!r} is out of range")
    for name in ("cell", "bytes", "epoch", "stamp_ns", "offset", "stored"):
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


def _check_sizes(entries: tuple[Entry, ...], file_bytes: int) -> None:
    """Refuse a file that unpacks to too much, or does not contain its first part itself."""
    own = [entry for entry in entries if entry.file is None]
    if PartKey(MAP) not in {entry.key for entry in own}:
        raise DamagedMapFileError(f"{MANIFEST}: it does not list the part {MAP}")
    for entry in entries:
        if entry.size > MAX_PART_BYTES:
            raise DamagedMapFileError(
                f"{MANIFEST}: a part {entry.key.topic:.80} exceeds {MAX_PART_BYTES} bytes"
            )
    if (total := sum(entry.size for entry in own)) > total_limit(file_bytes):
        raise DamagedMapFileError(f"{MANIFEST}: parts of {total} bytes in a file of {file_bytes}")


def total_limit(file_bytes: int) -> int:
    """Return the bytes to which all parts of a file of ``file_bytes`` may decompress together."""
    return _FREE_TOTAL_BYTES + _MAX_TOTAL_RATIO * file_bytes


def _entries(
    columns: Mapping[str, NDArray[Any]], topics: list[str], files: list[str | None]
) -> Iterable[Entry]:
    digests = [digest.tobytes() for digest in columns["sha256"]]
    others = [columns[name].tolist() for name in _COLUMNS if name != "sha256"]
    for digest, row in zip(digests, zip(*others, strict=True), strict=True):
        topic, region, plane, cell, size, epoch, stamp_ns, file, offset, stored = row
        yield Entry(
            PartKey(topics[topic], tuple(region), plane=plane, cell=cell),
            size=size,
            sha256=digest,
            epoch=epoch,
            stamp_ns=stamp_ns,
            file=files[file],
            offset=offset,
            stored=stored,
        )
