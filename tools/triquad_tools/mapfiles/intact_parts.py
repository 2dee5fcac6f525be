"""The intact parts of a damaged map file, or of a checkpoint.

Nothing in a map file says where a chunk is: each is found by how it begins, and checked by
its checksum. So nothing that is damaged hides what lies behind it.
"""

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from triquad_format import errors
from triquad_format.mapfile.container import chunk_messages, decompress
from triquad_format.mapfile.files import FileBytes
from triquad_format.mapfile.index import CheckpointIndex, is_checkpoint
from triquad_format.mapfile.manifest import Entry, Manifest, manifest_in, total_limit
from triquad_format.mapfile.metadata import MAX_MAP_BYTES, unpack_facts
from triquad_format.mapfile.parts import part
from triquad_format.mapfile.parts.body import unpack_body
from triquad_format.records.region import MapRecord

_LEAST_BUDGET, _BUDGET_RATIO = 2**24, 8
"""Bytes of all places whose contents are tried: a constant, and a multiple of the file's size."""

_CHUNK = re.compile(rb"\x06(.{4})\x00{4}.{28}(\x04\x00{3}zstd|\x00{4})(.{4})\x00{4}", re.DOTALL)
"""The head of a chunk record below 4 GiB: its length, then times, size, checksum, the name of its
compression, and the length of what is stored."""


_TOPIC = re.compile(rb"[\x80-\x8f]\xa5topic[\xa0-\xbf](/triquad/[a-z]+)")
"""The beginning of a part: a short msgpack map, whose first key is ``topic``."""


@dataclass(frozen=True)
class IntactParts:
    """The parts of the field and of training that are intact, and what is known of the others."""

    facts: MapRecord  # without its regions
    payloads: Mapping[part.PartKey, bytes]
    manifest: Manifest | None = None  # None: it is lost

    @property
    def listed(self) -> frozenset[part.PartKey]:
        """The parts of regions that there were, as far as the manifest says."""
        entries = () if self.manifest is None else self.manifest.entries
        return frozenset(entry.key for entry in entries if entry.key.topic in part.REGION_TOPICS)


def intact_parts(path: Path) -> IntactParts:
    """Return the intact parts of a map file, or of a checkpoint with what its store has of it.

    Raises:
        UnsupportedMapFileError: the file needs a newer reader.
        TooLargeMapFileError: it exceeds the limits of map files.
        MapFileError: nothing says what map this is, or its server deleted it meanwhile.
        OSError: it cannot be read.
    """
    with closing(FileBytes(path)) as file:
        if is_checkpoint(file):
            return _checkpoint_parts(CheckpointIndex(file))
        payloads = list(_payloads(file))
    manifest = _manifest(payloads)
    if manifest is not None:
        by_digest = {hashlib.sha256(payload).digest(): payload for payload in payloads}
        return _listed_parts(manifest, lambda entry: by_digest.get(entry.sha256))
    for payload in payloads:
        if _part_topic(payload) == part.MAP:
            facts = unpack_facts(unpack_body(part.MAP, payload))
            keyed = ((_own_key(payload), payload) for payload in payloads)
            return IntactParts(facts, {key: data for key, data in keyed if key is not None})
    raise errors.MapFileError("nothing can be saved: neither its first part nor its last is intact")


def _manifest(payloads: list[bytes]) -> Manifest | None:
    for payload in payloads:
        if _part_topic(payload) == part.MANIFEST:
            try:
                # A file that was cut lists parts for which it has no room: any size will do.
                return manifest_in(unpack_body(part.MANIFEST, payload), MAX_MAP_BYTES)
            except errors.UnsupportedMapFileError:
                raise
            except errors.FormatError:
                continue
    return None


def _checkpoint_parts(index: CheckpointIndex) -> IntactParts:
    def intact(entry: Entry) -> bytes | None:
        with suppress(errors.DamagedMapFileError, OSError):
            return index.payload(entry)
        return None

    return _listed_parts(index.manifest, intact)


def _listed_parts(manifest: Manifest, payload_of: Callable[[Entry], bytes | None]) -> IntactParts:
    """Return the parts of regions that a manifest lists, of those that have a payload."""
    entries = [entry for entry in manifest.entries if entry.key.topic in part.REGION_TOPICS]
    tried = ((entry.key, payload_of(entry)) for entry in entries)
    found = {key: payload for key, payload in tried if payload is not None}
    return IntactParts(manifest.facts, found, manifest)


def _own_key(payload: bytes) -> part.PartKey | None:
    topic = _part_topic(payload)
    if topic not in part.REGION_TOPICS:
        return None
    with suppress(errors.FormatError):
        body = unpack_body(topic, payload)
        if topic in (part.REGION, part.TRAINING):
            return part.PartKey(topic, body.index())
        return part.PartKey(topic, body.index(), plane=body.count("plane"), cell=body.count("cell"))
    return None


def _payloads(file: FileBytes) -> Iterator[bytes]:
    size = file.size
    if size > MAX_MAP_BYTES:
        raise errors.TooLargeMapFileError(f"it is larger than the limit of {MAX_MAP_BYTES} bytes")
    data = file.read(0, size)
    left = min(MAX_MAP_BYTES, total_limit(size))
    for message in _intact_messages(data):
        try:
            payload = decompress(message)
        except errors.FormatError:
            continue  # a preview, which is no zstd frame
        if (left := left - len(payload)) < 0:
            raise errors.TooLargeMapFileError(
                "its intact parts exceed the limit given for its size"
            )
        yield payload


def _intact_messages(data: bytes) -> Iterator[bytes]:
    budget = _LEAST_BUDGET + _BUDGET_RATIO * len(data)
    at = 0
    while match := _CHUNK.search(data, at):
        start, at = match.start(), match.start() + 1
        end = start + 9 + int.from_bytes(match[1], "little")
        # Checked by its head alone, at no cost: what only resembles a chunk takes no budget.
        fills = match.end() + int.from_bytes(match[3], "little") == end
        if not fills or end > len(data) or end - start > budget:
            continue
        budget -= end - start
        with suppress(errors.FormatError):
            yield from chunk_messages(data[start:end], start)
            at = end


def _part_topic(payload: bytes) -> str | None:
    """Return the topic that a part names first; ``None``: it is no part."""
    match = _TOPIC.match(payload)
    return None if match is None else match[1].decode()
