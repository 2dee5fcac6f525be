"""A copy of a map, as ``sync`` keeps one, and what it must fetch to be up to date."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from triquad_format.mapfile.writer import write_map
from triquad_map.stored_map import StoredMap
from triquad_server.epochs.epoch import Epoch


@dataclass(frozen=True)
class MapCopy:
    """The parts of a map at one time."""

    parts: Mapping[object, bytes]  # their digests

    @classmethod
    def of(cls, epoch: Epoch) -> "MapCopy":
        """A copy without training state, as it is downloaded."""
        with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
            path = Path(name) / "map.triquad"
            write_map(epoch.record(), path)
            with StoredMap.open(path) as stored:
                return cls({entry.key: entry.sha256 for entry in stored.manifest.entries})

    def fetched_by(self, older: "MapCopy") -> int:
        """How many of its parts one fetches who has an older copy."""
        return sum(older.parts.get(key) != digest for key, digest in self.parts.items())
