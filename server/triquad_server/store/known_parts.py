"""The parts of the newest checkpoint, and the files that hold them."""

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.parts.part import MAP, PartKey
from triquad_format.records.field_settings import RegionIndex

_MAX_FILES = 8
_MAX_STORED_RATIO = 1.5  # of stored bytes to those that are needed
_LARGE_SHARE = 0.5


@dataclass(frozen=True)
class KnownParts:
    """The parts of the newest checkpoint, in any file: they need not be written again.

    Each entry names the file with the part, as any later file sees it.
    """

    facts: MapFacts
    stamp_ns: int
    entries: Mapping[PartKey, Entry]
    stored: Mapping[str, int]  # bytes of the parts in each of its files, by name, needed or not

    @classmethod
    def after(cls, manifest: Manifest, file: str, stored_before: Mapping[str, int]) -> "KnownParts":
        """Return the parts once the file of the name ``file`` with this manifest is on the disk.

        ``stored_before`` gives the bytes of the parts in each of the other files.
        """
        stored = {other: stored_before.get(other, 0) for other in manifest.files}
        stored[file] = own_bytes(manifest)
        return cls(
            manifest.facts, manifest.stamp_ns, entries=manifest.elsewhere(file), stored=stored
        )

    @property
    def files(self) -> frozenset[str]:
        """Return the names of all its files."""
        return frozenset(self.stored)

    @property
    def worth_folding(self) -> bool:
        """Return whether the files are many, or a third of their bytes is no longer needed."""
        needed = sum(entry.size for entry in self.entries.values())
        stored = sum(self.stored.values())
        return len(self.stored) > _MAX_FILES or stored > _MAX_STORED_RATIO * needed

    def of_region(self, index: RegionIndex) -> list[Entry]:
        """Return the parts of a region, in their order."""
        return [
            entry for key, entry in self.entries.items() if key.region == index and key.topic != MAP
        ]

    def is_small(self, regions: Collection[RegionIndex]) -> bool:
        """Return whether these regions take so little that the others are better not rewritten."""
        sizes = [(key.region, e.size) for key, e in self.entries.items() if key.topic != MAP]
        changed = sum(size for region, size in sizes if region in regions)
        return changed < _LARGE_SHARE * sum(size for _, size in sizes)

    def stored_here(self) -> dict[PartKey, Entry]:
        """Return the entries in the form for a file that holds all parts itself."""
        return {key: dataclasses.replace(e, file=None) for key, e in self.entries.items()}


def own_bytes(manifest: Manifest) -> int:
    """Return the bytes of the parts in the manifest's own file."""
    return sum(entry.size for entry in manifest.own)
