"""The intact parts of a damaged map file, and of the other files that it needs."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import (
    FormatError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.index import file_in
from triquad_format.mapfile.manifest import Manifest, unpack_manifest
from triquad_format.mapfile.mcap.chunks import total_limit
from triquad_format.mapfile.mcap.random_access import FileBytes
from triquad_format.mapfile.mcap.records import Message
from triquad_format.mapfile.metadata import MapFacts, check_readable, unpack_facts
from triquad_format.mapfile.parts.body import unpack_body
from triquad_format.mapfile.parts.part import (
    MANIFEST,
    MAP,
    REGION,
    REGION_TOPICS,
    TRAINING,
    PartKey,
)
from triquad_format.records.region import RegionIndex
from triquad_format.recovery.intact_chunks import found_metadata, intact_messages


@dataclass(frozen=True)
class IntactParts:
    """The parts of the field and of training that are intact, and what is known of the others."""

    facts: MapFacts
    payloads: Mapping[PartKey, bytes]
    missing: frozenset[PartKey]  # as far as the manifest tells
    parts_listed: int | None  # in the manifest; None: it is lost
    stamp_ns: int  # when the epoch was written, nanoseconds since 1970; 0 if not known

    @property
    def regions(self) -> list[RegionIndex]:
        """The regions of which there is a part, or was one."""
        return list(dict.fromkeys(key.region for key in (*self.payloads, *sorted(self.missing))))

    def found_of(self, region: RegionIndex) -> dict[PartKey, bytes]:
        """The parts of a region."""
        return {key: data for key, data in self.payloads.items() if key.region == region}

    def missing_of(self, region: RegionIndex) -> set[PartKey]:
        """The parts that a region lacks."""
        return {key for key in self.missing if key.region == region}


def intact_parts(path: Path, max_bytes: int) -> IntactParts:
    """The intact parts of a file, and of those beside it that it needs.

    Args:
        path: the file.
        max_bytes: limit on each file's size and, decompressed, on its parts together.

    Raises:
        UnsupportedMapFileError: the file needs a newer reader.
        TooLargeMapFileError: it exceeds ``max_bytes``.
        MapFileError: nothing tells what map this is.
        OSError: it cannot be read.
    """
    messages = list(_messages(path, max_bytes))
    manifest = _manifest(messages, path.stat().st_size)
    if manifest is not None:
        return _listed_parts(manifest, messages, path.parent, max_bytes=max_bytes)
    facts = _facts(messages)
    if facts is None:
        raise MapFileError("nothing can be saved: neither its first part nor its last is intact")
    keyed = ((_own_key(message), message.data) for message in messages)
    payloads = {key: data for key, data in keyed if key is not None}
    return IntactParts(facts, payloads, missing=frozenset(), parts_listed=None, stamp_ns=0)


def _messages(path: Path, max_bytes: int) -> Iterator[Message]:
    """The messages in all intact chunks of a file."""
    with closing(FileBytes(path)) as file:
        size = file.size
        if size > max_bytes:
            raise TooLargeMapFileError(f"it is larger than the limit of {max_bytes} bytes")
        data = file.read(0, size)
    _refuse_newer(found_metadata(data))
    return intact_messages(data, min(max_bytes, total_limit(size)))


def _refuse_newer(metadata: dict[str, str]) -> None:
    try:
        check_readable(metadata)
    except UnsupportedMapFileError:
        follows, needed = (
            metadata.get(key, "") for key in ("format_version", "min_reader_version")
        )
        # Else the metadata is damaged itself.
        if follows.isdecimal() and needed.isdecimal() and int(follows) >= int(needed):
            raise
    except MapFileError:
        return  # damaged, too: the parts will tell


def _manifest(messages: Iterable[Message], file_bytes: int) -> Manifest | None:
    for message in messages:
        if message.channel.topic == MANIFEST:
            try:
                return unpack_manifest(message.data, file_bytes)
            except FormatError:
                return None
    return None


def _facts(messages: Iterable[Message]) -> MapFacts | None:
    for message in messages:
        if message.channel.topic == MAP:
            try:
                return unpack_facts(unpack_body(MAP, message.data))
            except FormatError:
                return None
    return None


def _listed_parts(
    manifest: Manifest, messages: list[Message], folder: Path, *, max_bytes: int
) -> IntactParts:
    """The parts that a manifest lists, known by their digests."""
    entries = [entry for entry in manifest.entries if entry.key.topic in REGION_TOPICS]
    wanted = {entry.sha256 for entry in entries}
    found = _by_digest(messages, wanted)
    for file in manifest.files:
        try:
            found |= _by_digest(_messages(file_in(folder, file.name), max_bytes), wanted)
        except (FormatError, OSError):
            continue
    payloads = {e.key: found[e.sha256] for e in entries if e.sha256 in found}
    missing = frozenset(entry.key for entry in entries if entry.sha256 not in found)
    return IntactParts(
        manifest.facts,
        payloads,
        missing=missing,
        parts_listed=len(entries),
        stamp_ns=manifest.stamp_ns,
    )


def _by_digest(messages: Iterable[Message], wanted: set[bytes]) -> dict[bytes, bytes]:
    digests = ((hashlib.sha256(message.data).digest(), message.data) for message in messages)
    return {digest: data for digest, data in digests if digest in wanted}


def _own_key(message: Message) -> PartKey | None:
    """What a part says that it is of."""
    topic = message.channel.topic
    if topic not in REGION_TOPICS:
        return None
    try:
        body = unpack_body(topic, message.data)
        if topic in (REGION, TRAINING):
            return PartKey(topic, body.index())
        return PartKey(topic, body.index(), plane=body.count("plane"), cell=body.count("cell"))
    except FormatError:
        return None
