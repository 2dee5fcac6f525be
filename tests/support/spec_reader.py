"""A reader of version 1 map files, written from docs/map-file.md and nothing of the project.

It keeps the page honest: what it cannot read or answers otherwise, the page does not tell.
It is no example of a safe reader: of the limits and ranges it checks few.
"""

import hashlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zstandard
from support.spec_parts import Array, Key, Map, Settings, check, plain, rays_of

MAGIC = b"\x89MCAP0\r\n"
FOOTER, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX = 2, 4, 5, 6, 8
ATTACHMENT, METADATA, METADATA_INDEX, DATA_END = 9, 12, 13, 15
FEATURES = {"", "base-files"}
NAMES = "map region vertices evidence training moments samples rays manifest"
TOPICS = {f"/triquad/{name}" for name in NAMES.split()}


def sha256(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


# MCAP


def strings(data: bytes, count: int) -> list[str]:
    """The first strings of a record's content."""
    found: list[str] = []
    at = 0
    while len(found) < count and at < len(data):
        size = struct.unpack_from("<I", data, at)[0]
        found.append(data[at + 4 : at + 4 + size].decode())
        at += 4 + size
    return found


def records(data: bytes, at: int = 0) -> Iterator[tuple[int, int, bytes]]:
    """Start, opcode and content of each record."""
    while at < len(data):
        code, size = struct.unpack_from("<BQ", data, at)
        check(at + 9 + size <= len(data), "a record is cut off")
        yield at, code, data[at + 9 : at + 9 + size]
        at += 9 + size


def crc_matches(data: bytes, want: int) -> bool:
    return want in (0, zlib.crc32(data))


def unchunked(content: bytes) -> bytes:
    """The records in a chunk."""
    size, crc = struct.unpack_from("<QI", content, 16)
    compression = strings(content[28:], 1)[0]
    data = content[28 + 4 + len(compression) + 8 :]
    check(compression in ("", "zstd"), f"unknown compression {compression}")
    if compression:
        check(zstandard.frame_content_size(data) in (-1, size), "size of a zstd frame")
        decompressor = zstandard.ZstdDecompressor(max_window_size=1 << 23)
        data = decompressor.decompress(data, size, allow_extra_data=False)
    check(len(data) == size and crc_matches(data, crc), "size or checksum of a chunk")
    return data


def metadata_of(content: bytes) -> dict[str, str]:
    """Values of the metadata record ``triquad``; empty for another."""
    name = strings(content, 1)[0]
    values = strings(content[4 + len(name.encode()) + 4 :], 1 << 20)
    return dict(zip(values[::2], values[1::2], strict=True)) if name == "triquad" else {}


def footer_of(tail: bytes) -> tuple[int, int]:
    """Where the summary begins, and its checksum, from the last 37 bytes."""
    check(tail[29:] == MAGIC and tail[:9] == struct.pack("<BQ", FOOTER, 20), "footer")
    return struct.unpack_from("<Q8xI", tail, 9)


Channels = dict[int, tuple[str, str]]
"""Topic and message encoding by the channel's number."""


def channel_of(content: bytes) -> Channels:
    topic, encoding = strings(content[4:], 2)
    return {struct.unpack_from("<H", content)[0]: (topic, encoding)}


def part_of(content: bytes, channels: Channels) -> list[tuple[str, bytes]]:
    """Topic and payload of a message, if it is a part."""
    topic, encoding = channels[struct.unpack_from("<H", content)[0]]
    if not topic.startswith("/triquad/") and topic != "/preview/mesh":
        return []
    check(topic not in TOPICS or encoding == "msgpack", f"encoding of {topic}")
    return [(topic, content[22:])]


# Whole files


def check_container(data: bytes) -> None:
    """Magic and the checksums of the data section and the summary."""
    check(data[:8] == MAGIC, "magic")
    summary, crc = footer_of(data[-37:])
    check(crc_matches(data[summary or len(data) - 37 : -12], crc), "checksum of the summary")
    ends = [(at, body) for at, code, body in records(data[:-8], 8) if code == DATA_END]
    check(len(ends) == 1, "one DataEnd")
    check(crc_matches(data[: ends[0][0]], *struct.unpack("<I", ends[0][1])), "data section")


def scan(data: bytes) -> tuple[dict[str, str], list[tuple[str, bytes]]]:
    """Metadata and parts of a file."""
    metadata: list[dict[str, str]] = []
    channels: Channels = {}
    parts: list[tuple[str, bytes]] = []
    for _, code, content in records(data[:-8], 8):
        inner = records(unchunked(content)) if code == CHUNK else [(0, code, content)]
        for _, kind, body in inner:
            if kind == CHANNEL:
                channels |= channel_of(body)
            elif kind == MESSAGE:
                parts += part_of(body, channels)
            elif kind == METADATA:
                metadata += [values for values in (metadata_of(body),) if values]
            elif kind == ATTACHMENT:
                check(crc_matches(body[:-4], *struct.unpack("<I", body[-4:])), "attachment")
    check(len(metadata) == 1, "one metadata record triquad")
    return metadata[0], parts


def read_whole(path: Path) -> tuple["Manifest", dict[Key, bytes]]:
    """Manifest and payloads of a map, those of its base files among them."""
    manifest, parts = read_file(path)
    for i, base in enumerate(manifest.files, 1):
        other, theirs = read_file(path.parent / base["name"])
        check(other.digest == base["manifest"], "another base file")
        parts |= {row.key: theirs.get(row.key, b"") for row in manifest.rows if row.file == i}
    check(all(row.matches(row.key[0], parts[row.key]) for row in manifest.rows), "digest")
    (map_part,) = (parts[row.key] for row in manifest.rows if row.key[0] == "/triquad/map")
    check(msgpack.unpackb(map_part).items() <= manifest.values.items(), "facts of the map")
    return manifest, parts


def read_file(path: Path) -> tuple["Manifest", dict[Key, bytes]]:
    """Manifest and payloads of one file."""
    data = path.read_bytes()
    check_container(data)
    metadata, parts = scan(data)
    check_versions(metadata)
    check(parts and parts[-1][0] == "/triquad/manifest", "the manifest is the last part")
    manifest = Manifest(parts.pop()[1], metadata)
    check(len(parts) == len(manifest.own), "parts are missing or too many")
    for (topic, payload), row in zip(parts, manifest.own, strict=True):
        check(row.matches(topic, payload), f"another part for {row.key}")
    return manifest, {row.key: part[1] for row, part in zip(manifest.own, parts, strict=True)}


# Manifest


@dataclass(frozen=True)
class Row:
    """One part in the manifest."""

    key: Key
    size: int
    digest: bytes
    file: int

    def matches(self, topic: str, payload: bytes) -> bool:
        same = topic == self.key[0] and len(payload) == self.size
        return same and sha256(payload) == self.digest


def check_versions(metadata: dict[str, str]) -> None:
    check(int(metadata["min_reader_version"]) <= 1, "a newer version")
    names = {name.strip() for name in metadata["required_features"].split(",")}
    check(names <= FEATURES, f"required features {names}")


class Manifest:
    """Section 7, with what the metadata must say."""

    def __init__(self, payload: bytes, metadata: dict[str, str]) -> None:
        self.digest = sha256(payload)
        self.values: dict[str, Any] = msgpack.unpackb(payload)
        self.files: list[dict[str, Any]] = self.values["files"]
        pairs = (("map", "name"), ("epoch", "epoch"), ("frame_id", "frame_id"), ("units", "units"))
        check(all(metadata[a] == str(self.values[b]) for a, b in pairs), "metadata")
        column = {name: plain(array).tolist() for name, array in self.values["parts"].items()}
        topics = [self.values["topics"][i] for i in column["topic"]]
        regions = [tuple(index) for index in column["region"]]
        keys = list(zip(topics, regions, column["plane"], column["cell"], strict=True))
        check(len(set(keys)) == len(keys), "a key twice")
        digests = map(bytes, column["sha256"])
        columns = (keys, column["bytes"], digests, column["file"])
        self.rows = [Row(*values) for values in zip(*columns, strict=True)]
        self.own = [row for row in self.rows if row.file == 0]


# Section 9


@dataclass
class IndexedFile:
    """A file of which only what is asked for is read."""

    path: Path
    bytes_read: int = 0
    bases: dict[int, "IndexedFile"] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.size = self.path.stat().st_size
        start, crc = footer_of(self.at(self.size - 37, 37))
        summary = self.at(start, self.size - 12 - start)
        check(crc and crc_matches(summary, crc), "checksum of the summary")
        self.channels: Channels = {}
        self.chunks: list[tuple[int, int]] = []
        metadata: list[dict[str, str]] = []
        for _, code, body in records(summary[:-25]):
            if code == CHANNEL:
                self.channels |= channel_of(body)
            elif code == CHUNK_INDEX:
                self.chunks.append(struct.unpack_from("<QQ", body, 16))
            elif code == METADATA_INDEX and strings(body[16:], 1) == ["triquad"]:
                metadata.append(metadata_of(self.at(*struct.unpack_from("<QQ", body))[9:]))
        check(len(metadata) == 1, "one metadata record triquad")
        check_versions(metadata[0])
        topic, payload = self.part(len(self.chunks) - 1)
        check(topic == "/triquad/manifest", "the manifest is in the last chunk")
        self.manifest = Manifest(payload, metadata[0])

    def at(self, offset: int, size: int) -> bytes:
        self.bytes_read += size
        with self.path.open("rb") as file:
            file.seek(offset)
            return file.read(size)

    def part(self, chunk: int) -> tuple[str, bytes]:
        _, _, content = next(records(self.at(*self.chunks[chunk])))
        inner = [body for _, code, body in records(unchunked(content)) if code == MESSAGE]
        check(len(inner) == 1, "one part to a chunk")
        return part_of(inner[0], self.channels)[0]

    def base(self, number: int) -> "IndexedFile":
        if number not in self.bases:
            stored = self.manifest.files[number - 1]
            self.bases[number] = IndexedFile(self.path.parent / stored["name"])
            check(self.bases[number].manifest.digest == stored["manifest"], "another base file")
        return self.bases[number]

    def read(self, row: Row) -> bytes:
        file = self.base(row.file) if row.file else self
        i = [own.key for own in file.manifest.own].index(row.key)
        topic, payload = file.part(i)
        check(row.matches(topic, payload), f"another part for {row.key}")
        return payload


def read_near(path: Path, points: Array) -> tuple[IndexedFile, dict[Key, bytes]]:
    """Only the parts which the answers at the points need."""
    file = IndexedFile(path)
    settings = Settings(file.manifest.values["settings"])
    rows = (row for row in file.manifest.rows if settings.needs(row.key, points))
    return file, {row.key: file.read(row) for row in rows}


def load(path: Path) -> Map:
    """A map, all of whose files were read."""
    manifest, parts = read_whole(path)
    return Map(manifest.values, parts)


def load_rays(path: Path, settings: Settings) -> Array:
    """Rays of all regions [R, 7]: where they end, their origins, metres, and their slopes."""
    _, parts = read_whole(path)
    found = []
    for (topic, index, _, cell), payload in parts.items():
        if topic == "/triquad/rays":
            training = msgpack.unpackb(parts["/triquad/training", index, 0, 0])
            found.append(rays_of(msgpack.unpackb(payload), cell, training, settings))
    return np.concatenate(found)
