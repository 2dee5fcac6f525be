"""Map files damaged at a chosen place."""

import os
from dataclasses import dataclass
from pathlib import Path

from support.files.mapfile_edit import manifest_of, metadata_of


@dataclass(frozen=True)
class Chunk:
    """Where a part lies in a file."""

    topic: str
    start: int
    end: int

    @property
    def middle(self) -> int:
        """A place within its data."""
        return (self.start + self.end) // 2


def chunks(data: bytes) -> list[Chunk]:
    """The chunks of a file, one to a part, in their order; that of the manifest is the last."""
    own = [(e.key.topic, e.offset, e.offset + e.stored) for e in manifest_of(data).entries]
    start, size = map(int, metadata_of(data)["manifest"].split())
    return [Chunk(*place) for place in (*own, ("/triquad/manifest", start, start + size))]


def first_chunk(data: bytes, topic: str) -> Chunk:
    """Where the first part of a topic lies."""
    return next(chunk for chunk in chunks(data) if chunk.topic == topic)


def flipped(data: bytes, *places: int) -> bytes:
    """The bytes with one bit changed at each of these places."""
    corrupt = bytearray(data)
    for place in places:
        corrupt[place] ^= 0x10
    return bytes(corrupt)


def rot(path: Path) -> None:
    """Damage a file as a disk does: nothing but its bytes tells."""
    before = path.stat()
    path.write_bytes(flipped(path.read_bytes(), before.st_size // 2))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def zeroed(data: bytes, first: int, last: int) -> bytes:
    """The bytes with zeros from ``first`` to before ``last``."""
    return data[:first] + bytes(len(data[first:last])) + data[last:]
