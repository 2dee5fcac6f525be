"""A reader of version 1 map files, written from docs/map-file.md and nothing of the project.

It keeps the page honest: what it cannot read or answers otherwise, the page does not tell.
It is no example of a safe reader: of the limits and ranges it checks few.
"""

import hashlib
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zstandard
from support.files.spec_answers import Map, origin_of
from support.files.spec_parts import Array, Key, Settings, check, plain, rays_of

MAGIC = b"\x89MCAP0\r\n"
FOOTER, MESSAGE, CHUNK, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 2, 5, 6, 12, 13, 14, 15
NAMES = "map region vertices evidence training moments samples rays manifest"
TOPICS = {f"/triquad/{name}" for name in NAMES.split()}


# Section 2


def strings(data: bytes, count: int) -> list[str]:
    """The first strings of a record's content."""
    found: list[str] = []
    at = 0
    while len(found) < count and at < len(data):
        size = struct.unpack_from("<I", data, at)[0]
        found.append(data[at + 4 : at + 4 + size].decode())
        at += 4 + size
    return found


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record."""
    at = 0
    while at < len(data):
        code, size = struct.unpack_from("<BQ", data, at)
        check(at + 9 + size <= len(data), "a record is cut off")
        yield code, data[at + 9 : at + 9 + size]
        at += 9 + size


def message_in(place: bytes) -> bytes:
    """The data of the one message in the chunk at a place."""
    code, content = next(records(place))
    check(code == CHUNK, "no chunk")
    size, crc = struct.unpack_from("<QI", content, 16)
    compression = strings(content[28:], 1)[0]
    data = content[28 + 4 + len(compression) + 8 :]
    check(compression in ("", "zstd"), f"unknown compression {compression}")
    if compression:
        check(zstandard.frame_content_size(data) in (-1, size), "size of a zstd frame")
        data = zstandard.ZstdDecompressor().decompress(data, size)
    check(len(data) == size and crc in (0, zlib.crc32(data)), "size or checksum of a chunk")
    (message,) = (body for code, body in records(data) if code == MESSAGE)
    return message[22:]


def unpacked(topic: str, data: bytes) -> bytes:
    """The payload in a message of a topic."""
    if not topic.startswith("/triquad/"):
        return data
    decompressor = zstandard.ZstdDecompressor(max_window_size=1 << 23)
    return decompressor.decompress(data, allow_extra_data=False)


@dataclass
class OpenFile:
    """A file of which only what is asked for is read."""

    path: Path
    bytes_read: int = 0

    def at(self, offset: int, size: int) -> bytes:
        self.bytes_read += size
        with self.path.open("rb") as file:
            file.seek(offset)
            data = file.read(size)
        check(len(data) == size, "the file is cut off")
        return data

    def metadata(self) -> dict[str, str]:
        """Values of the record ``triquad``, once the checksum of the summary is found right."""
        size = self.path.stat().st_size
        footer = self.at(size - 37, 37)
        check(footer[29:] == MAGIC and footer[:9] == struct.pack("<BQ", FOOTER, 20), "footer")
        start, offsets, crc = struct.unpack_from("<QQI", footer, 9)
        summary = self.at(start, size - start - 8)
        check(crc == zlib.crc32(summary[:-4]), "checksum of the summary")
        groups = [
            struct.unpack_from("<QQ", body, 1)
            for code, body in records(summary[offsets - start :])
            if code == SUMMARY_OFFSET and body[0] == METADATA_INDEX
        ]
        found = [
            struct.unpack_from("<QQ", body)
            for first, length in groups
            for _, body in records(summary[first - start : first - start + length])
            if strings(body[16:], 1) == ["triquad"]
        ]
        check(len(found) == 1, "one metadata record triquad")
        code, content = next(records(self.at(*found[0])))
        check(code == METADATA, "metadata")
        _, values = strings(content, 1), strings(content[4 + len("triquad") + 4 :], 1 << 20)
        return dict(zip(values[::2], values[1::2], strict=True))

    def check_data(self) -> None:
        """Compare the checksum of the data section."""
        data = self.path.read_bytes()
        (start,) = struct.unpack_from("<Q", data, len(data) - 28)
        (code, crc) = next(records(data[start - 13 : start]))
        check(code == DATA_END and data[:8] == MAGIC, "end of the data, or magic")
        check(struct.unpack("<I", crc)[0] == zlib.crc32(data[: start - 13]), "data section")


# Section 7


@dataclass(frozen=True)
class Row:
    """One part in the manifest."""

    key: Key
    size: int
    digest: bytes
    offset: int
    stored: int

    def checked(self, payload: bytes) -> bytes:
        """The payload of the part, which has this digest."""
        same = len(payload) == self.size and hashlib.sha256(payload).digest() == self.digest
        check(same, f"another part for {self.key}")
        if self.key[0] in TOPICS:
            check(topic_of(payload) == self.key[0], "another topic")
        return payload


def topic_of(payload: bytes) -> str:
    key, value = next(iter(msgpack.unpackb(payload).items()))
    check(key == "topic", "the topic comes first")
    return str(value)


def rows_of(values: dict[str, Any]) -> list[Row]:
    """The parts that a manifest lists."""
    column = {name: plain(array).tolist() for name, array in values["parts"].items()}
    topics = [values["topics"][i] for i in column["topic"]]
    regions = [tuple(index) for index in column["region"]]
    keys = list(zip(topics, regions, column["plane"], column["cell"], strict=True))
    check(len(set(keys)) == len(keys), "a key twice")
    rest = [column[name] for name in ("offset", "stored")]
    columns = (keys, column["bytes"], map(bytes, column["sha256"]), *rest)
    return [Row(*row) for row in zip(*columns, strict=True)]


def manifest_in(payload: bytes) -> dict[str, Any]:
    """The values of a manifest."""
    check(topic_of(payload) == "/triquad/manifest", "no manifest")
    values: dict[str, Any] = msgpack.unpackb(payload)
    check(values["min_reader_version"] <= 2, "a newer version")
    return values


class MapFile:
    """A map file: its manifest, and what else is asked for."""

    def __init__(self, path: Path) -> None:
        self.file = OpenFile(path)
        metadata = self.file.metadata()
        check(int(metadata["min_reader_version"]) <= 2, "a newer version")
        place = map(int, metadata["manifest"].split(" "))
        self.values = manifest_in(unpacked("/triquad/manifest", message_in(self.file.at(*place))))
        pairs = (("map", "name"), ("epoch", "epoch"), ("frame_id", "frame_id"), ("units", "units"))
        check(all(metadata[a] == str(self.values[b]) for a, b in pairs), "metadata")
        self.rows = rows_of(self.values)

    def read(self, row: Row) -> bytes:
        """The payload of a part."""
        place = self.file.at(row.offset, row.stored)
        return row.checked(unpacked(row.key[0], message_in(place)))


def read_whole(path: Path) -> tuple[MapFile, dict[Key, bytes]]:
    """A map and the payloads of all its parts, all of whose checksums are right."""
    whole = MapFile(path)
    whole.file.check_data()
    parts = {row.key: whole.read(row) for row in whole.rows}
    (first,) = (msgpack.unpackb(parts[key]) for key in parts if key[0] == "/triquad/map")
    facts = {key: value for key, value in first.items() if key != "topic"}
    check(facts.items() <= whole.values.items(), "facts of the map")
    return whole, parts


def read_near(path: Path, points: Array) -> tuple[MapFile, dict[Key, bytes]]:
    """Section 9: only the parts which the answers at the points need."""
    whole = MapFile(path)
    settings = Settings(whole.values["settings"])
    places = points - origin_of(whole.values)
    rows = (row for row in whole.rows if settings.needs(row.key, places))
    return whole, {row.key: whole.read(row) for row in rows}


def load(path: Path) -> Map:
    """A map, all of whose files were read."""
    whole, parts = read_whole(path)
    return Map(whole.values, parts)


def load_rays(path: Path, settings: Settings) -> Array:
    """Rays of all regions [R, 7]: where they end, their origins, metres, and their slopes."""
    _, parts = read_whole(path)
    found = []
    for (topic, index, _, cell), payload in parts.items():
        if topic == "/triquad/rays":
            training = msgpack.unpackb(parts["/triquad/training", index, 0, 0])
            found.append(rays_of(msgpack.unpackb(payload), cell, training, settings))
    return np.concatenate(found)


# Section 10


def load_checkpoint(path: Path) -> Map:
    """The map of a checkpoint in its folder."""
    line, digest, frame = (path.read_bytes()[slice(*at)] for at in ((19,), (19, 51), (51, None)))
    check(line == b"triquad checkpoint\n", "no checkpoint")
    check(hashlib.sha256(frame).digest() == digest, "another list of parts")
    values = manifest_in(unpacked("/triquad/manifest", frame))
    parts = {}
    for row in rows_of(values):
        stored = (path.parent / "parts" / row.digest.hex()).read_bytes()
        check(len(stored) == row.stored, f"another size of {row.key}")
        parts[row.key] = row.checked(unpacked(row.key[0], stored))
    return Map(values, parts)
