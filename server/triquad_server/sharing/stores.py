"""The regions of a shared map as its servers' stores have them, each in a folder of its own."""

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path

from triquad_format.errors import DamagedMapFileError, FormatError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    PartFiles,
    checkpoint_files,
)
from triquad_format.mapfile.index import Checkpoint, read_checkpoint
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.wire.shares import share_number
from triquad_map.compiled.team import Split

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.errors import StoreError, StoreInUseError
from triquad_server.sharing.leases import Leases
from triquad_server.store.dropped import set_aside
from triquad_server.store.found_map import is_share_folder
from triquad_server.store.lock import StoreLock
from triquad_server.store.store import Store
from triquad_server.store.stored_regions import StoredRegions

_log = logging.getLogger(__name__)


class OtherStore:
    """The newest checkpoint of another server."""

    def __init__(
        self, folder: Path, field: FieldSettings, cache_bytes: Callable[[], int], split: Split
    ) -> None:
        """Begin with nothing; arguments as of :class:`Stores`."""
        self.regions = StoredRegions(folder, cache_bytes, split, is_foreign=True)
        self._folder = folder
        self._field = field
        self._read: CheckpointFile | None = None
        self.epoch = 0  # of the checkpoint; 0: there is none

    @property
    def known(self) -> Mapping[RegionIndex, ColdRegion]:
        """The regions that it has."""
        return self.regions.known

    def refresh(self) -> str | None:
        """Read the newest checkpoint, if there is a newer one; return why it cannot be used.

        Where it is damaged, that is an older one, as for the server that wrote it.
        """
        try:
            files = checkpoint_files(self._folder)
            if not files or files[0] == self._read:
                return None
            newest = next((found for file in files if (found := _readable(file))), None)
        except (FormatError, OSError) as error:
            return f"{self._folder} cannot be read: {error}"
        if newest is None or newest.regions is None or any(newest.manifest.facts.origin):
            return (
                f"{self._folder} has no valid checkpoint of a shared map: move it away, or start "
                f"triquad-server --map {self._folder.name} once, without --share, to see why"
            )
        manifest = newest.manifest
        if manifest.facts.settings != self._field:
            return (
                f"{self._folder} has other [field] settings: {manifest.facts.settings}; start with "
                "the same, or move it away"
            )
        known = self.regions.known
        changed = {
            index: entries
            for index, entries in manifest.of_regions().items()
            if index not in known or known[index].entries != tuple(entries)
        }
        self.regions.put(manifest.facts, changed, newest.regions, only=newest.regions)
        self._read, self.epoch = files[0], manifest.facts.epoch
        return None


class Stores:
    """The stores of all servers of a map, of which one is that of this server."""

    def __init__(
        self,
        own: Store,
        field: FieldSettings,
        cache_bytes: Callable[[], int],
        split: Split,
    ) -> None:
        """Read the folders next to that of this server.

        Args:
            own: of this server; the folders of the others differ in the number at their end.
            field: settings of the map; a store with others is left out.
            cache_bytes: that regions of all other stores may take that were read to answer.
            split: shares the work of a question.
        """
        self._own = own
        self._map_name = own.folder.name.rpartition(".")[0]
        self._field = field
        self._cache_bytes = cache_bytes
        self._split = split
        self._others: dict[int, OtherStore] = {}
        self.problems: dict[int, str] = {}  # why stores cannot be read, by their servers

    def refresh(self) -> None:
        """Read what is newer than the last time."""
        # Replaced as a whole: other threads count what is in memory of them.
        self._others = {
            number: self._others.get(number) or self._other(folder)
            for number, folder in self._folders()
        }
        before, self.problems = self.problems, {}
        for number, store in self._others.items():
            if (problem := store.refresh()) is not None:
                self.problems[number] = problem
                if before.get(number) != problem:
                    _log.warning("%s", problem)

    def _other(self, folder: Path) -> OtherStore:
        return OtherStore(folder, self._field, self._cache_bytes_each, self._split)

    def _cache_bytes_each(self) -> int:
        return self._cache_bytes() // max(1, len(self._others))

    def check(self) -> None:
        """Raise :class:`StoreError` where a store cannot be read: what is in it may be newer."""
        if self.problems:
            raise StoreError("; ".join(self.problems.values()))

    def newest(self, leases: Leases) -> dict[RegionIndex, ColdRegion]:
        """Return the regions that this server does not have.

        Each is as its owner's store has it, or as the newest one does, where it has no owner, or
        that has written no checkpoint since it took it. What an owner has removed is not among
        them.
        """
        held = leases.held
        known = {number: store.known for number, store in self._others.items()}
        known[leases.number] = self._own.regions.known
        newest: dict[RegionIndex, ColdRegion] = {}
        for index in {index for regions in known.values() for index in regions} - held:
            owner, since_ms = next(iter(leases.holders(index).items()), (None, 0))
            found = {
                number: regions[index] for number, regions in known.items() if index in regions
            }
            if owner in self._others and self._others[owner].epoch > since_ms:
                if owner in found:
                    newest[index] = found[owner]
            else:
                newest[index] = max(found.values(), key=version_of)
        return newest

    def own(self, region: ColdRegion) -> ColdRegion:
        """Return a region as this server's own store has it, to which it is copied if need be.

        Raises:
            StoreError: it cannot be read, or written.
        """
        if not region.is_foreign:
            return region
        stores = (store.regions for store in self._others.values())
        other = next(one for one in stores if one.known.get(region.index) is region)
        return self._own.adopt(region, other)

    def set_aside_empty(self, leases: Leases) -> None:
        """Set aside the stores of servers that went, once others have checkpoints of all in them.

        So nothing that was removed since can come back from there. The first server does it.
        """
        gone = self._others.keys() - leases.others - leases.contests.others - self.problems.keys()
        if not gone or leases.number > min(leases.others, default=leases.number):
            return
        for number in gone:
            store = self._others[number]
            owners = {index: next(iter(leases.holders(index)), number) for index in store.known}
            is_empty = not store.epoch and not PartFiles(self.folder(number)).names()
            if (store.epoch or is_empty) and number not in owners.values():
                own = self._own.versions()
                if all(
                    self._version_at(owner, index, own) >= version_of(store.known[index])
                    for index, owner in owners.items()
                ):
                    self._set_aside(self.folder(number))

    def _version_at(self, number: int, index: RegionIndex, own: Mapping[RegionIndex, int]) -> int:
        """Return as of when the newest checkpoint of a server has a region; -1: it has not.

        ``own`` tells it of this server's.
        """
        if number not in self._others:
            return own.get(index, -1)
        region = self._others[number].known.get(index)
        return -1 if region is None else version_of(region)

    def _set_aside(self, folder: Path) -> None:
        try:
            with closing(StoreLock(folder)):
                to = set_aside(folder)
            _log.info("%s is in the stores of other servers by now, and kept as %s", folder, to)
        except StoreInUseError:
            _log.debug("%s is in use, though its server is not seen", folder)
        except OSError as error:
            _log.warning("%s is not needed, but cannot be set aside: %s", folder, error)

    @property
    def cache_bytes(self) -> int:
        """The bytes of regions of other stores that were read to answer."""
        return sum(store.regions.cache.bytes for store in self._others.values())

    def clear(self) -> None:
        """Keep none of these any more."""
        for store in self._others.values():
            store.regions.cache.clear()

    def folder(self, number: int) -> Path:
        """Return the folder of a server."""
        return self._own.folder.with_name(f"{self._map_name}.{number}")

    def _folders(self) -> Iterator[tuple[int, Path]]:
        for path in self._own.folder.parent.iterdir():
            number = share_number(path.name)
            is_of_map = number and path == self.folder(number) and is_share_folder(path)
            if number and is_of_map and path != self._own.folder:
                yield number, path


def version_of(region: ColdRegion) -> int:
    """Return when a region changed last, as numbers of epochs count."""
    return max((entry.epoch for entry in region.entries), default=0)


def _readable(file: CheckpointFile) -> Checkpoint | None:
    """Return a checkpoint; ``None`` where it is damaged, a map file, or deleted meanwhile."""
    try:
        return read_checkpoint(file.path)
    except (DamagedMapFileError, FileNotFoundError):
        return None
