"""The live map, owned by one thread: it takes in scans, trains, and publishes epochs."""

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import MapProgress, MapRecord

from triquad_server.engine.compiled_trainer import Loss
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.memory import memory_on
from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.epochs.epoch import Epoch
from triquad_server.errors import NO_MEMORY, ScanRefusedError
from triquad_server.intake.rays import ScanRays, usable_rays
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.live_regions import LiveRegions
from triquad_server.mapping.map_snapshot import MapFigures, MapSnapshot
from triquad_server.mapping.memory_budget import MemoryBudget
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.process.memory_share import MemoryShare, ServerMemory
from triquad_server.process.threads import Teams
from triquad_server.settings import ANY_SOURCE, Settings

_log = logging.getLogger(__name__)

_LOSS_MEMORY = 0.95

_NOWHERE_YET = np.zeros(3)


class Mapper:
    """Builds and trains a map, without files and clocks."""

    def __init__(
        self,
        name: str,
        settings: Settings,
        device: str,
        record: MapRecord | None = None,
        teams: Teams | None = None,
        cold: Mapping[RegionIndex, ColdRegion] = MappingProxyType({}),
        memory: MemoryShare | None = None,
    ) -> None:
        """Make a map that goes on from ``record``; without ``teams`` it has threads of its own.

        ``cold`` are regions that are not in the record, to be read when they are needed. Without a
        share of ``memory`` it has all that the settings allow.
        """
        self.name = name
        self.teams = teams or Teams()
        self.settings = settings
        self.device = device
        self._setup = RegionSetup(
            field=record.settings if record else settings.field,
            scan=settings.scan,
            change=settings.change,
            training=settings.training,
            memory=memory_on(device),
            sums=GradientSums(),
            team=self.teams.mapping,
        )
        self.memory = memory or ServerMemory(settings.memory.max_bytes).open()
        budget = MemoryBudget(self.memory, self._setup.field, settings.training)
        self.regions = LiveRegions(self._setup, budget)
        self._number = record.epoch if record else 0
        self._epoch: Epoch | None = None
        self._version: int | None = None  # of the regions, as they were published last
        self._least_number: Callable[[], int] = lambda: 0  # of the next epoch
        self.rests = False  # it is not trained: regions are made again, which takes the cores
        # Chosen by the first scan, and kept as long as this process runs, also after a reset.
        is_begun = record is not None and (record.regions or record.progress.scans_taken)
        self._origin = record.origin if record is not None and is_begun else None
        # Of the map: a restart goes on counting.
        progress = record.progress if record else MapProgress()
        self.scans_taken = progress.scans_taken
        self.samples_trained = progress.samples_trained
        self._loss: Loss | None = progress.loss or None
        if record is not None:
            self.regions.restore(record.regions)
            self.regions.all.restore_cold(cold)
            self.regions.share_out()

    @property
    def origin(self) -> Doubles:
        """[3] of the user's coordinates, from where the map counts: 0 0 0 until it is chosen."""
        return _NOWHERE_YET if self._origin is None else self._origin

    @property
    def field(self) -> FieldSettings:
        """The settings of all fields."""
        return self._setup.field

    @property
    def settled(self) -> bool:
        """Return whether nothing is left to learn from the scans so far."""
        return self.samples_left == 0

    @property
    def samples_left(self) -> int:
        """The number of training samples that are still to be trained on, of all regions."""
        return self.regions.all.samples_left

    @property
    def loss(self) -> float:
        """The loss of the last steps; on a GPU, reading it waits for all of them."""
        return 0.0 if self._loss is None else float(self._loss)

    @property
    def progress(self) -> MapProgress:
        """Return how far the map has come; on a GPU, this waits for the last steps."""
        loss = self.loss
        # A loss that is not a number must not keep a map from being written.
        return MapProgress(
            self.scans_taken, self.samples_trained, loss if math.isfinite(loss) else 0.0
        )

    def figures(self) -> MapFigures:
        """Return the figures of the map as it is now."""
        return MapFigures(
            scans_taken=self.scans_taken,
            samples_trained=self.samples_trained,
            samples_left=self.samples_left,
            samples_discarded=self.regions.all.samples_discarded,
            rays_kept=self.regions.all.rays_kept,
            rays_discarded=self.regions.all.rays_discarded,
            replay_share=self.regions.rays_share,
            map_bytes=self.regions.bytes_used,
        )

    def ingest(
        self,
        points: Floats,
        world_from_sensor: Doubles,
        stamp_s: int = 0,
        *,
        source: str = "",
        no_return: Floats | None = None,
        local: bool = False,
    ) -> ScanRays:
        """Take in a scan.

        Args:
            points: [N, 3] metres, sensor frame.
            world_from_sensor: pose [4, 4].
            stamp_s: when it was taken, seconds since 1970.
            source: its settings apply; empty: those of no particular source.
            no_return: directions [M, 3], sensor frame, of rays that met nothing.
            local: whether the pose counts from the map's origin.

        Returns:
            What of it is used, from the map's origin, and how many points and rays without a
            return are not. It counts as taken where it reaches a region of this map.

        Raises:
            ScanRefusedError: the scan cannot be used; the map is unchanged.
            NoRoomYetError: it has to wait while there is no room; likewise. After any other
                exception a part of the scan is in the map, which must not be used any more.
        """
        origin = np.zeros(3) if local else self._origin
        rays = self._usable_rays(points, world_from_sensor, source, no_return, origin)
        reached = self.regions.reached_by(rays)
        if self._origin is None:
            self._origin = rays.map_origin
        if reached:
            self._take_in(rays, reached, stamp_s)
            self.regions.room.make()
            self.scans_taken += 1
        return rays

    def _usable_rays(
        self,
        points: Floats,
        pose: Doubles,
        source: str,
        no_return: Floats | None,
        origin: Doubles | None,
    ) -> ScanRays:
        """Return a scan's usable rays. A defect due to its numbers must not stop the mapping."""
        of_source = self.settings.sources.get(source, ANY_SOURCE)
        settings = self.settings.scan_of(of_source)
        try:
            return usable_rays(
                points, pose, settings, source=of_source, no_return=no_return, map_origin=origin
            )
        except ScanRefusedError:
            raise
        except MemoryError as error:
            raise ScanRefusedError("no_memory", NO_MEMORY) from error
        except Exception as error:
            _log.exception("a scan of %s could not be read", source or "no source")
            text = f"internal error of the server: {error!r}"
            raise ScanRefusedError("internal", text) from error

    def _take_in(self, rays: ScanRays, regions: list[LiveRegion], stamp_s: int) -> None:
        seen = [region.scan_seen(rays, stamp_s) for region in regions]
        for region, shown in zip(regions, seen, strict=True):
            region.believe(shown)
        self.regions.share_out()  # by the voxels that have surface so far
        for region, shown in zip(regions, seen, strict=True):
            region.scan_taken(rays, shown)

    def train(self) -> None:
        """Take one optimiser step where most is to be learnt; do nothing once all is settled."""
        region = self.regions.next_to_learn
        if region is None:
            return
        loss, samples = region.take_step()
        before = loss if self._loss is None else self._loss
        self._loss = _LOSS_MEMORY * before + (1 - _LOSS_MEMORY) * loss
        self.samples_trained += samples

    def publish(self) -> Epoch:
        """Return the newest epoch: a new one if the map changed since the last."""
        changed = self._version != self.regions.all.version
        changed = changed or any(region.is_changed for region in self.regions)
        if self._epoch is not None and not changed:
            return self._epoch
        if self._epoch is not None or not self._number:
            self._number = max(self._number + 1, self._least_number())
        self._epoch = Epoch(
            name=self.name,
            number=self._number,
            settings=self._setup.field,
            regions=self.regions.all.publish(self._number),
            split=self.teams.answer,
            progress=self.progress,
            origin=self.origin,
        )
        self._version = self.regions.all.version
        return self._epoch

    def share(
        self, may_have: Callable[[RegionIndex], bool], least_number: Callable[[], int]
    ) -> None:
        """Have some regions of a map that several servers share, which counts from 0 0 0.

        Args:
            may_have: whether this server has a region, or takes it now.
            least_number: of the next epoch. The same for all servers at a time, and rising, so that
                of two versions of a region the newer one is known.
        """
        self.regions.may_have = may_have
        self._least_number, self._origin = least_number, np.zeros(3)

    def release(self) -> None:
        """Free what only training needs, until there is something to learn again."""
        self._setup.sums.clear()

    def reset(self, minimum: Doubles, maximum: Doubles) -> None:
        """Forget what lies between two corners [3], metres, from the map's origin, which stays.

        Regions wholly between them disappear; where no region is left, the map begins again.
        """
        self.regions.forget(minimum, maximum)
        if not self.regions:
            self.scans_taken, self.samples_trained, self._loss = 0, 0, None

    def other(self, record: MapRecord | None, regions: frozenset[RegionIndex]) -> "Mapper":
        """Return another map that has some regions only, with these settings, name and origin.

        It goes on from a record, or begins with nothing. Another thread may own it.
        """
        other = Mapper(self.name, self.settings, self.device, teams=self.teams)
        other._setup, other._origin = self._setup, self._origin
        other.regions = self.regions.beginning(regions)
        if record is not None:
            other.regions.restore(record.regions)
            other.regions.share_out()
        return other

    def become(self, other: "Mapper") -> None:
        """Have what another map has learnt of its regions in place of what this one has.

        The other one must not be used any more. Epochs, scans and samples are counted on.
        """
        self.regions.replace(other.regions)

    def snapshot_of_leaving(self) -> MapSnapshot:
        """Return the newest epoch, and the regions that leave memory once they are stored."""
        newest = self.publish()
        owed = deque(region.owe() for region in self.regions.room.leaving)
        return MapSnapshot(owed, newest, self.regions.all.facts())

    def snapshot_since(self, epoch: int | None) -> MapSnapshot:
        """Return the newest epoch, and the regions changed after ``epoch``; ``None``: all.

        Those that are not in memory have not changed since they were stored.
        """
        newest = self.publish()
        changed = (one for one in self.regions if epoch is None or not one.is_as_of(epoch))
        owed = deque(region.owe() for region in changed)
        return MapSnapshot(owed, newest, self.regions.all.facts())
