"""The parts of a checkpoint: those that changed, and those that older files hold."""

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from triquad_format.errors import MapFileError
from triquad_format.mapfile.index import OtherFiles
from triquad_format.mapfile.manifest import Entry, FileRef, Manifest
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.parts.pack import pack_region
from triquad_format.mapfile.parts.part import MAP, Part, PartKey
from triquad_format.records.field_settings import RegionIndex

from triquad_server.mapping.mapper import MapChanges
from triquad_server.mesh.preview import preview_part

_FEATURE_DTYPE = "<f2"
_MAX_FILES = 8
_MAX_STORED_RATIO = 1.5  # of the bytes that are needed
_LARGE_SHARE = 0.5


@dataclass(frozen=True)
class KnownParts:
    """The parts of the newest checkpoint, wherever they lie: what need not be written again.

    Each entry names the file with the part, as any later file sees it.
    """

    facts: MapFacts
    stamp_ns: int
    entries: Mapping[PartKey, Entry]
    stored: Mapping[FileRef, int]  # bytes of the parts in each of its files, needed or not

    @property
    def files(self) -> frozenset[str]:
        """Names of all its files."""
        return frozenset(file.name for file in self.stored)

    @property
    def worth_folding(self) -> bool:
        """Whether the files are many, or a third of their bytes is no longer needed."""
        needed = sum(entry.size for entry in self.entries.values())
        stored = sum(self.stored.values())
        return len(self.stored) > _MAX_FILES or stored > _MAX_STORED_RATIO * needed

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
    manifest: Manifest, file: FileRef, stored_before: Mapping[FileRef, int]
) -> KnownParts:
    """What is known once ``file`` with this manifest is on the disk.

    ``stored_before`` gives the bytes of the parts in each of the other files.
    """
    stored = {other: stored_before.get(other, 0) for other in manifest.files}
    stored[file] = own_bytes(manifest)
    return KnownParts(manifest.facts, manifest.stamp_ns, manifest.elsewhere(file), stored)


def own_bytes(manifest: Manifest) -> int:
    """Bytes of the parts in the manifest's own file."""
    return sum(entry.size for entry in manifest.own)


class StoppedError(Exception):
    """Something is more urgent: what is left of the parts is not asked for."""


def checkpoint_parts(
    changes: MapChanges, known: KnownParts | None, others: OtherFiles | None, stamp_ns: int
) -> Iterator[Part | Entry]:
    """The parts of a checkpoint; those that did not change are copied from ``others``, if given."""
    changed = {region.index: region for region in changes.record.regions}
    settings = changes.record.settings
    for index in changes.regions:
        region = changed.get(index)
        if region is not None:
            yield from pack_region(region, settings, _FEATURE_DTYPE)
            yield preview_part(region, settings, changes.epoch.distances, stamp_ns)
        elif known is not None:
            entries = known.of_region(index)
            yield from entries if others is None else copied_parts(entries, others)


def copied_parts(entries: Iterable[Entry], others: OtherFiles) -> Iterator[Part]:
    """Parts that other files hold, read and checked; the map's own part is made anew.

    Raises:
        MapFileError: one of the files cannot be read, or is damaged.
    """
    for entry in entries:
        if entry.key.topic == MAP:
            continue
        try:
            payload = others.payload(entry)
        except OSError as error:  # of reading: the file that is written is another
            raise MapFileError(f"a file that holds parts cannot be read: {error}") from error
        yield Part(entry.key, payload)


def abortable(stopping: Callable[[], bool], parts: Iterator[Part]) -> Iterator[Part]:
    """The parts, until ``stopping()``.

    Raises:
        StoppedError: it says so.
    """
    for part in parts:
        if stopping():
            raise StoppedError
        yield part
