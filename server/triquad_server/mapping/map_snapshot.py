"""A live map as it was at a moment: its figures, and what a checkpoint needs of it."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from triquad_format.mapfile.region_facts import FactsByRegion
from triquad_format.records.region import MapRecord, Region

from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.live_region import OwedCopy, RegionSnapshot


@dataclass(frozen=True)
class MapFigures:
    """The figures of a live map, by their names in the status."""

    scans_taken: int = 0  # also those before a restart
    samples_trained: int = 0  # also those before a restart
    samples_left: int = 0
    samples_discarded: int = 0  # so far, beyond the limit of what may be left
    rays_kept: int = 0  # to train on; one that crosses regions counts in each
    rays_discarded: int = 0  # so far, that were replaced by others, or were too many
    replay_share: float = 1.0  # kept, of the rays that each place is to keep
    map_bytes: int = 0  # of regions in memory with their rays and the newest epoch; an estimate


@dataclass(frozen=True)
class MapSnapshot:
    """The map as it was at a moment, and which regions have changed since another.

    Each is copied when it is asked for, or before it changes: so there are copies of few at once.
    """

    changed: deque[OwedCopy]
    epoch: Epoch  # the same state, for queries
    facts: FactsByRegion  # of all regions in it

    def records(
        self, take: Callable[[OwedCopy], RegionSnapshot] = OwedCopy.take
    ) -> Iterator[Region]:
        """Yield the changed regions with training state: a second for 100 m of a street.

        They can be had once. ``take`` takes each copy, on the thread that owns the map.
        """
        while self.changed:
            yield take(self.changed.popleft()).record()

    def close(self) -> None:
        """Let go of copies that nobody took: an error that is kept may keep this snapshot."""
        self.changed.clear()

    def record(self) -> MapRecord:
        """Return the map with the changed regions, where the caller's thread owns the map."""
        return self.epoch.record(tuple(self.records()))
