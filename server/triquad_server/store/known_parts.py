"""The parts that the newest checkpoint consists of, wherever they lie: what need not be written."""

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from triquad_format.mapfile.manifest import Entry, FileRef, Manifest
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.parts.part import MAP, PartKey
from triquad_format.records.region import RegionIndex

_MAX_FILES = 8
_MAX_HELD = 1.5
_LARGE_SHARE = 0.5


@dataclass(frozen=True)
class KnownParts:
    """The newest checkpoint, seen from outside: every entry names the file that holds the part."""

    facts: MapFacts
    stamp_ns: int
    entries: Mapping[PartKey, Entry]
    held: Mapping[FileRef, int]  # bytes of the parts in each of its files, needed or not

    @property
    def files(self) -> frozenset[str]:
        """Names of all its files."""
        return frozenset(file.name for file in self.held)

    @property
    def worth_folding(self) -> bool:
        """Whether the files are many, or a third of their bytes is no longer needed."""
        live = sum(entry.size for entry in self.entries.values())
        held = sum(self.held.values())
        return len(self.held) > _MAX_FILES or held > _MAX_HELD * live

    def of_region(self, index: RegionIndex) -> list[Entry]:
        """The parts of a region, in their order."""
        return [
            entry for key, entry in self.entries.items() if key.region == index and key.topic != MAP
        ]

    def is_small(self, regions: Collection[RegionIndex]) -> bool:
        """Whether these regions take so little that the others are better not written again."""
        sizes = [(key.region, e.size) for key, e in self.entries.items() if key.topic != MAP]
        changed = sum(size for region, size in sizes if region in regions)
        return changed < _LARGE_SHARE * sum(size for _, size in sizes)

    def stored_here(self) -> dict[PartKey, Entry]:
        """The entries as a file lists them that holds all parts itself."""
        return {key: dataclasses.replace(e, file=None) for key, e in self.entries.items()}


def known_parts(
    manifest: Manifest, file: FileRef, held_before: Mapping[FileRef, int]
) -> KnownParts:
    """What is known once ``file`` with this manifest is on the disk.

    ``held_before`` gives the bytes of the parts in each of the other files.
    """
    held = {other: held_before.get(other, 0) for other in manifest.files}
    held[file] = own_bytes(manifest)
    return KnownParts(manifest.facts, manifest.stamp_ns, manifest.elsewhere(file), held)


def own_bytes(manifest: Manifest) -> int:
    """Bytes of the parts in the manifest's own file."""
    return sum(entry.size for entry in manifest.own)
