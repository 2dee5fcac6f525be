"""The intact parts of a damaged map file, and of the other files that it needs.

Nothing in a file tells where a chunk is: each is found by how it begins, and told from chance by
its checksum. So nothing that is damaged hides what lies behind it.
"""

import contextlib
import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from triquad_format.errors import (
    FormatError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.index import FileBytes, file_in
from triquad_format.mapfile.manifest import Manifest, unpack_manifest
from triquad_format.mapfile.mcap.records import (
    Channel,
    Message,
    metadata_entries,
    read_chunk,
    total_limit,
    walk,
)
from triquad_format.mapfile.metadata import METADATA_NAME, MapFacts, check_readable, unpack_facts
from triquad_format.mapfile.parts.body import unpack_body
from triquad_format.mapfile.parts.part import (
    ENCODINGS,
    MANIFEST,
    MAP,
    REGION,
    REGION_TOPICS,
    TRAINING,
    PartKey,
)
from triquad_format.records.field_settings import RegionIndex

_Content = TypeVar("_Content")

_LEAST_BUDGET, _BUDGET_RATIO = 2**24, 8
"""Bytes of all places whose contents are tried: a constant, and a multiple of the file's size."""

# A record below 4 GiB; in a chunk then times, size and checksum, and the name of its compression.
_CHUNK = re.compile(rb"\x06.{4}\x00{4}.{28}(?:\x04\x00{3}zstd|\x00{4})", re.DOTALL)
_METADATA = re.compile(rb"\x0c.{4}\x00{4}\x07\x00{3}" + METADATA_NAME.encode(), re.DOTALL)
_CHANNEL = re.compile(rb"\x04.{4}\x00{4}(..)...\x00{3}(/[a-z/]+).\x00{3}([a-z]+)\x00{4}", re.DOTALL)


@dataclass(frozen=True)
class PartsOfRegion:
    """The parts of one region."""

    found: dict[PartKey, bytes] = field(default_factory=dict)  # payloads of those that are intact
    missing: set[PartKey] = field(default_factory=set)  # as far as the manifest tells


@dataclass(frozen=True)
class IntactParts:
    """The parts of the field and of training that are intact, and what is known of the others."""

    facts: MapFacts
    payloads: Mapping[PartKey, bytes]
    missing: frozenset[PartKey]  # as far as the manifest tells
    parts_listed: int | None  # in the manifest; None: it is lost
    stamp_ns: int  # when the epoch was written, nanoseconds since 1970; 0 if not known

    def by_region(self) -> dict[RegionIndex, "PartsOfRegion"]:
        """The regions of which there is a part, or was one."""
        regions: dict[RegionIndex, PartsOfRegion] = {}
        for key, data in self.payloads.items():
            regions.setdefault(key.region, PartsOfRegion()).found[key] = data
        for key in sorted(self.missing):
            regions.setdefault(key.region, PartsOfRegion()).missing.add(key)
        return regions


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
    size = path.stat().st_size
    manifest = _first(messages, MANIFEST, lambda data: unpack_manifest(data, size))
    if manifest is not None:
        return _listed_parts(manifest, messages, path.parent, max_bytes=max_bytes)
    facts = _first(messages, MAP, lambda data: unpack_facts(unpack_body(MAP, data)))
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


def _first(
    messages: Iterable[Message], topic: str, read: Callable[[bytes], _Content]
) -> _Content | None:
    """What the first part of a topic holds; ``None``: there is none, or it is malformed."""
    for message in messages:
        if message.channel.topic == topic:
            with contextlib.suppress(FormatError):
                return read(message.data)
            break
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


def intact_messages(data: bytes, max_bytes: int) -> Iterator[Message]:
    """The messages of all intact chunks, in the order of the file.

    Args:
        data: what there is of the file.
        max_bytes: limit on all decompressed chunks together.

    Raises:
        TooLargeMapFileError: there is more.
    """
    channels = _channels(data)
    budget = _LEAST_BUDGET + _BUDGET_RATIO * len(data)
    at = 0
    while match := _CHUNK.search(data, at):
        at = match.start() + 1
        try:
            record = next(walk(memoryview(data), match.start()))
            # Told by its head alone, at no cost: what only looks like a chunk takes no budget.
            chunk = read_chunk(record)
            if len(record.content) > budget:
                continue
            budget -= len(record.content)
            messages = list(chunk.messages(dict(channels)))
        except FormatError:
            continue
        max_bytes -= chunk.size
        if max_bytes < 0:
            raise TooLargeMapFileError("its intact chunks exceed the limit given for its size")
        yield from messages
        at = record.end


def found_metadata(data: bytes) -> dict[str, str]:
    """The entries of the first metadata record ``triquad`` that can be read; empty: of none."""
    for match in _METADATA.finditer(data):
        with contextlib.suppress(FormatError):
            return metadata_entries(next(walk(memoryview(data), match.start())))[1]
    return {}


def _channels(data: bytes) -> dict[int, Channel]:
    """Channels by number: as records in the file say, else as files are written.

    The records stand twice in a file, and have no checksum of their own.
    """
    usual = [Channel(topic, encoding) for topic, encoding in ENCODINGS.items()]
    channels = dict(enumerate(usual, start=1))
    for match in _CHANNEL.finditer(data):
        channel = Channel(match[2].decode(), match[3].decode())
        if channel in usual:
            channels[int.from_bytes(match[1], "little")] = channel
    return channels
