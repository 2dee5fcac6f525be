"""The regions of a store, each as its newest checkpoint has it, to be read one by one."""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

from triquad_format.errors import FormatError, RefusedError
from triquad_format.mapfile.checkpoint_folder import NewParts, PartFiles, checkpoint_files
from triquad_format.mapfile.index import read_checkpoint
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.parts.pack import pack_region
from triquad_format.mapfile.reader import assemble
from triquad_format.mapfile.record_check import check_region
from triquad_format.mapfile.region_facts import FactsByRegion
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import MapRecord, Region
from triquad_map.compiled.team import Split

from triquad_server.epochs.cold_region import ColdRegion, RegionCache

_log = logging.getLogger(__name__)

_FEATURE_DTYPE = "<f2"


class StoredRegions:
    """Tells what the store has of each region, and reads it.

    That is what the newest checkpoint has, or what was written since to leave memory: the next
    checkpoint names it.
    """

    def __init__(
        self,
        folder: Path,
        cache_bytes: Callable[[], int],
        split: Split,
        *,
        is_foreign: bool = False,
    ) -> None:
        """Begin with none; of those that are read, ``cache_bytes()`` stay in memory.

        The folder ``is_foreign`` where another server of a shared map writes to it.
        """
        self._is_foreign = is_foreign
        self.folder = folder
        self._parts = PartFiles(folder)
        self.facts = MapRecord("none", 0, FieldSettings(), ())  # without regions
        self.cache = RegionCache(self._read, cache_bytes, split)
        self.known: Mapping[RegionIndex, ColdRegion] = {}

    @property
    def part_names(self) -> set[str]:
        """The names of all parts that are needed to read them."""
        return {entry.name for region in self.known.values() for entry in region.entries}

    def put(
        self,
        record: MapRecord,
        parts: Mapping[RegionIndex, Sequence[Entry]],
        facts: FactsByRegion,
        only: Collection[RegionIndex] | None = None,
    ) -> None:
        """Tell that regions were written as of a record's epoch; where ``only`` these are there.

        Others stay as they were.
        """
        self.facts = record.facts
        centre = record.settings.region_centre
        written = {
            index: ColdRegion(
                index,
                centre(index),
                facts[index],
                record.epoch,
                tuple(entries),
                self.cache,
                self._is_foreign,
            )
            for index, entries in parts.items()
        }
        known = {**self.known, **written}
        self.known = known if only is None else {i: r for i, r in known.items() if i in only}
        self.cache.drop_all_but(self.known)

    def adopt(self, region: ColdRegion, facts: MapRecord) -> ColdRegion:
        """Have a region of another store, whose parts were copied; ``facts`` are of its map.

        Its epoch is none of this server's: once it is in memory, it is written before it leaves.
        """
        self.facts = facts
        own = ColdRegion(region.index, region.centre, region.facts, 0, region.entries, self.cache)
        self.known = {**self.known, region.index: own}
        return own

    def mend(self, name: str) -> None:
        """Take older parts of a region whose part ``name`` is damaged, if there are any."""
        for region in self.known.values():
            if name in {entry.name for entry in region.entries}:
                self.take_older(region)

    def _read(self, region: ColdRegion, topics: Collection[str]) -> MapRecord:
        """Read the parts of a region; where one is damaged, those of an older checkpoint.

        Raises:
            RefusedError: ``store``; there is none that is whole, or the disk cannot be read.
                ``epoch_gone``: the region has changed since, and these parts are not kept.
        """
        try:
            return self._assembled(region, topics)
        except OSError as error:
            raise RefusedError("store", f"region {region.index} cannot be read: {error}") from error
        except FormatError as error:
            if self.known.get(region.index) is not region:
                raise RefusedError("epoch_gone", "ask the newest: it is not kept") from error
            _log.error("region %s cannot be read: %s", region.index, error)
            if not self.take_older(region):
                raise RefusedError(
                    "store",
                    f"region {region.index} cannot be read, and no older checkpoint has it whole: "
                    f"{error}; reset its box to begin it again, or restore a backup",
                ) from error
        try:
            return self._assembled(region, topics)
        except (FormatError, OSError) as error:
            raise RefusedError("store", f"region {region.index} cannot be read: {error}") from error

    def _assembled(self, region: ColdRegion, topics: Collection[str]) -> MapRecord:
        entries = tuple(one for one in region.entries if one.key.topic in topics)
        return assemble(Manifest(self.facts, 0, entries), self._parts.payload)

    def take_older(self, region: ColdRegion) -> bool:
        """Have a region be as the newest checkpoint has it that has it whole, if there is any.

        The next checkpoint names these parts, so that they stay.
        """
        try:
            files = checkpoint_files(self.folder)
        except OSError:
            return False
        for file in files:
            try:
                checkpoint = read_checkpoint(file.path)
                parts = {} if checkpoint is None else checkpoint.manifest.of_regions()
                entries = parts.get(region.index, [])
                for entry in entries:
                    self._parts.check(entry.name)
            except (FormatError, OSError):
                continue
            if entries:
                region.entries = tuple(entries)
                _log.warning("region %s is used as of epoch %d instead", region.index, file.epoch)
                return True
        return False


def write_regions(
    folder: Path,
    record: MapRecord,
    regions: Iterable[Region],
    before: Mapping[RegionIndex, Sequence[Entry]],
) -> dict[RegionIndex, list[Entry]]:
    """Write those parts of regions that are not in a store's folder yet; return all of each.

    Args:
        folder: of the checkpoints.
        record: the map, without regions.
        regions: each is made when it is written.
        before: parts that are known to be there, as they were written.

    Raises:
        FormatError: a region is malformed.
        OSError: a part cannot be written.
    """
    new = NewParts(folder, record.epoch)
    written: dict[RegionIndex, list[Entry]] = {}
    for region in regions:
        check_region(record.settings, region)
        known = {entry.key: entry for entry in before.get(region.index, ())}
        written[region.index] = [
            new.add(part, known.get(part.key))
            for part in pack_region(region, record.settings, _FEATURE_DTYPE)
        ]
        del region  # before the next one is made
    new.commit()
    return written
