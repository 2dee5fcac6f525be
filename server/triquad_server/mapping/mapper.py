"""The live map: takes in scans, trains, publishes epochs. Owned by one thread."""

import logging
import math

import numpy as np
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.map_progress import MapProgress
from triquad_format.records.region import MapRecord

from triquad_server.engine.compiled_trainer import GradientSums
from triquad_server.engine.memory import memory_on
from triquad_server.engine.shortage import shortages
from triquad_server.engine.trainer import Loss
from triquad_server.epochs.epoch import Epoch, FrozenRegion
from triquad_server.errors import MapLostError, ScanRefusedError
from triquad_server.intake.rays import ScanRays, usable_rays
from triquad_server.mapping.fair_share import FairShare
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.map_snapshot import MapChanges, MapSnapshot
from triquad_server.mapping.memory_budget import NO_SIZE, MemoryBudget
from triquad_server.mapping.normals import SurfaceNormals
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.regions_around import regions_around
from triquad_server.process.threads import Teams
from triquad_server.settings import ANY_SOURCE, Settings

_log = logging.getLogger(__name__)

_LOSS_MEMORY = 0.95


class Mapper:
    """A map that grows and learns. It knows no files and no clocks."""

    def __init__(
        self,
        name: str,
        settings: Settings,
        device: str,
        record: MapRecord | None = None,
        teams: Teams | None = None,
    ) -> None:
        """A map that goes on from its ``record``; without ``teams`` it has threads of its own."""
        self._name = name
        self._teams = teams or Teams()
        self._settings = settings
        self._field_settings = record.settings if record else settings.field
        self._normals = self._no_normals()
        self._setup = RegionSetup(
            field=self._field_settings,
            scan=settings.scan,
            change=settings.change,
            training=settings.training,
            memory=memory_on(device),
            sums=GradientSums(),
            team=self._teams.mapping,
        )
        self._budget = MemoryBudget(settings.memory.max_bytes, self._field_settings)
        self._regions: dict[RegionIndex, LiveRegion] = {}
        self._number = record.epoch if record else 0
        self._epoch: Epoch | None = None
        self._structure_changed = True
        # Regions of the newest epoch that a failed scan took, and for which memory is short.
        self._missing: dict[RegionIndex, FrozenRegion] = {}
        self._share = FairShare.of(0, settings.training)
        # Of the map: a restart goes on counting.
        progress = record.progress if record else MapProgress()
        self.scans_taken = progress.scans_taken
        self.samples_trained = progress.samples_trained
        self._loss: Loss | None = progress.loss or None
        for region in record.regions if record else ():
            self._regions[region.index] = live = LiveRegion.restore(region, self._setup)
            self._normals.restore(live.ray_ends())
        self._share_out()

    def _no_normals(self) -> SurfaceNormals:
        return SurfaceNormals(self._field_settings.leaf_m, self._teams.mapping)

    @property
    def settled(self) -> bool:
        """Whether nothing is left to learn from the scans so far."""
        return self.samples_left == 0 and not self._missing

    @property
    def samples_left(self) -> int:
        """Training samples that are still owed, of all regions."""
        return sum(region.budget.samples for region in self._regions.values())

    @property
    def loss(self) -> float:
        """The loss of the last steps; on a GPU, to read it waits for all of them."""
        return 0.0 if self._loss is None else float(self._loss)

    @property
    def progress(self) -> MapProgress:
        """How far the map has come; to read it on a GPU waits for the last steps."""
        loss = self.loss
        # A loss that is no number must not keep a map from being written.
        return MapProgress(
            self.scans_taken, self.samples_trained, loss if math.isfinite(loss) else 0.0
        )

    @property
    def bytes_used(self) -> int:
        """Memory of the map with its newest epoch, without the replay pools; an estimate."""
        return self._budget.bytes_of(region.size for region in self._regions.values())

    @property
    def normals_bytes(self) -> int:
        """Memory of the moments of points, from which normals of coming scans are told."""
        return self._normals.nbytes

    @property
    def regions(self) -> list[LiveRegion]:
        """The regions; only the thread that owns the map may use them."""
        return list(self._regions.values())

    @property
    def rays_kept(self) -> int:
        """Rays that the replay pools hold an interval of, counted once for each region."""
        return sum(len(region.pool) for region in self._regions.values())

    @property
    def rays_discarded(self) -> int:
        """Rays so far that gave way to others, or were too many."""
        return sum(region.pool.discarded for region in self._regions.values())

    @property
    def samples_discarded(self) -> int:
        """Samples so far that more than the regions may owe would have been."""
        return sum(region.budget.discarded for region in self._regions.values())

    @property
    def replay_share(self) -> float:
        """Of the rays that each place is to keep, the share that memory has room for."""
        return self._share.rays_share

    def ingest(
        self,
        points: Floats,
        world_from_sensor: Doubles,
        stamp_s: int = 0,
        *,
        source: str = "",
        no_return: Floats | None = None,
    ) -> ScanRays:
        """Take in a scan.

        Args:
            points: [N, 3] metres, sensor frame.
            world_from_sensor: pose [4, 4].
            stamp_s: when it was taken, seconds since 1970.
            source: whose settings count; empty: those of no particular source.
            no_return: directions [M, 3], sensor frame, of rays that met nothing.

        Returns:
            What of it is used, and how many points and rays without a return are not.

        Raises:
            ScanRefusedError: the scan cannot be used; the map is unchanged. Where memory ran out
                amid it, the reason is ``out_of_memory``, and the map as after any other exception.
            MapLostError: the scan is half in the map, and what was published cannot be restored.
            Exception: the scan failed midway. Of it nothing is in the map: regions that it touched
                are as in the newest epoch.
        """
        of_source = self._settings.sources.get(source, ANY_SOURCE)
        try:
            self._restore_missing()
            rays = usable_rays(
                points,
                world_from_sensor,
                self._settings.scan_of(of_source),
                source=of_source,
                no_return=no_return,
            )
            around = regions_around(rays, self._regions, self._field_settings)
            self._check_regions(around)
            self._check_memory(rays, around)
            self._take_in_all(rays, around, stamp_s)
        except MemoryError as error:
            text = "the system gives the server no more memory"
            raise ScanRefusedError("out_of_memory", text) from error
        self.scans_taken += 1
        return rays

    def _take_in_all(self, rays: ScanRays, around: list[RegionIndex], stamp_s: int) -> None:
        """Take in a scan, all or nothing of it."""
        try:
            self._take_in(rays, around, stamp_s)
        except Exception:
            self._go_back(around)
            raise

    @shortages()
    def _take_in(self, rays: ScanRays, around: list[RegionIndex], stamp_s: int) -> None:
        regions = [self._region(index) for index in around]
        with self._teams.mapping.in_parallel() as start:
            for region in regions:
                start(region.see(rays, stamp_s))
            normals = self._normals.add(rays.ends, rays.origin)
            self._share_out()  # by the voxels that are seen by now
            for region in regions:
                region.learn(rays, normals)
        for region in regions:
            region.set_normals(normals)

    def _go_back(self, touched: list[RegionIndex]) -> None:
        """Undo a scan that failed midway: what it touched is again as it was published last.

        What those regions had learnt since, and what training needs beyond the field, goes too.
        Where memory is short, that is made up for before anything else happens to the map.

        Raises:
            MapLostError: that fails as well.
        """
        published = {old.index: old for old in self._epoch.frozen_regions} if self._epoch else {}
        for index in touched:
            self._regions.pop(index, None)  # first: memory may be what is short
        self.scans_taken = self._epoch.progress.scans_taken if self._epoch else 0
        self._structure_changed = True
        self._missing = {index: published[index] for index in published.keys() & set(touched)}
        try:
            self._normals = self._no_normals()
            self._restore_missing()
        except MemoryError as error:
            _log.warning("no memory to undo a scan that failed, tried again soon: %s", error)
        except Exception as error:
            text = f"a scan failed, and the map before it is lost: {error!r}"
            raise MapLostError(text) from error

    @shortages()
    def _restore_missing(self) -> None:
        """Have all regions again; MemoryError: not yet."""
        for index, frozen in list(self._missing.items()):
            self._regions[index] = LiveRegion.restore(frozen.record(), self._setup)
            del self._missing[index]
            self._share_out()

    @shortages()
    def train(self) -> None:
        """One optimiser step where most is owed for what is there; nothing once all is settled."""
        self._restore_missing()
        region = max(self._regions.values(), key=lambda r: r.owed, default=None)
        if region is None or region.budget.samples == 0:
            return
        loss = region.train()
        before = loss if self._loss is None else self._loss
        self._loss = _LOSS_MEMORY * before + (1 - _LOSS_MEMORY) * loss
        self.samples_trained += region.batch

    @shortages()
    def publish(self) -> Epoch:
        """The newest epoch: a new one where the map changed since the last."""
        self._restore_missing()
        changed = self._structure_changed or any(r.changed for r in self._regions.values())
        if self._epoch is not None and not changed:
            return self._epoch
        if self._epoch is not None or not self._number:
            self._number += 1
        before = {old.index: old for old in self._epoch.frozen_regions} if self._epoch else {}
        try:
            regions = tuple(self._freeze(region, before) for region in self._regions.values())
        except BaseException:
            for region in self._regions.values():  # the next epoch is to show what this did not
                region.changed = True
            raise
        self._epoch = Epoch(
            name=self._name,
            number=self._number,
            settings=self._field_settings,
            regions=regions,
            split=self._teams.answers.split,
            progress=self.progress,
        )
        self._structure_changed = False
        return self._epoch

    def release(self) -> None:
        """Free what training alone needs, until there is something to learn again."""
        self._setup.sums.clear()

    def reset(self, minimum: Doubles, maximum: Doubles) -> None:
        """Forget what lies between two corners [3], metres, map frame.

        Regions wholly between them disappear; where no region is left, the map begins anew.
        """
        self._restore_missing()
        half = self._field_settings.region_side_m / 2
        for index, region in list(self._regions.items()):
            low, high = region.centre - half, region.centre + half
            if ((minimum <= low) & (maximum >= high)).all():
                del self._regions[index]
            elif ((minimum < high) & (maximum > low)).all():
                region.forget(np.maximum(minimum, low), np.minimum(maximum, high))
        if not self._regions:
            self.scans_taken, self.samples_trained, self._loss = 0, 0, None
        self._normals.forget(minimum, maximum)
        self._share_out()
        self._structure_changed = True

    def changes_since(self, epoch: int | None) -> MapChanges:
        """The newest epoch, with training state, of the regions that changed after ``epoch``.

        ``None``: of all regions.
        """
        return self.snapshot_since(epoch).changes()

    @shortages()
    def snapshot_since(self, epoch: int | None) -> MapSnapshot:
        """As :meth:`changes_since`, of which other threads make the records."""
        newest = self.publish()
        changed = {
            frozen.index
            for frozen in newest.frozen_regions
            if epoch is None or frozen.changed > epoch
        }
        snapshots = tuple(
            region.snapshot() for index, region in self._regions.items() if index in changed
        )
        return MapSnapshot(
            self._name, self._field_settings, snapshots, tuple(self._regions), newest
        )

    def _freeze(self, region: LiveRegion, before: dict[RegionIndex, FrozenRegion]) -> FrozenRegion:
        """The region as it is now; the last frozen one where it did not change since."""
        if not region.changed and region.index in before:
            return before[region.index]
        return region.freeze(self._number, before.get(region.index))

    def _check_regions(self, wanted: list[RegionIndex]) -> None:
        limit = self._settings.training.max_regions
        count = len(self._regions.keys() | set(wanted))
        if count > limit:
            raise ScanRefusedError(
                "too_many_regions",
                f"the scan would make {count} regions of the map, more than "
                f"training.max_regions = {limit}",
            )

    def _check_memory(self, rays: ScanRays, wanted: list[RegionIndex]) -> None:
        """Refuse a scan that does not fit; the closer to the limit, the more exact the count.

        Raises:
            ScanRefusedError: ``map_full``.
        """
        used, budget = self.bytes_used, self._budget
        if used + budget.most_added(rays, [len(rays.ends)] * len(wanted)) <= budget.limit:
            return
        regions = [
            self._regions.get(index) or LiveRegion.unseen(index, self._setup) for index in wanted
        ]
        new_voxels = [len(region.new_ends(rays).voxels) for region in regions]
        if used + budget.most_added(rays, new_voxels) <= budget.limit:
            return
        unseen = budget.bytes_of(NO_SIZE for index in wanted if index not in self._regions)
        needed = unseen + sum(budget.grown(region.growth_by(rays)) for region in regions)
        if needed and used + needed > budget.limit:
            raise budget.refusal(used, needed)

    def _region(self, index: RegionIndex) -> LiveRegion:
        if index not in self._regions:
            self._regions[index] = LiveRegion.unseen(index, self._setup)
            self._structure_changed = True
        return self._regions[index]

    def _share_out(self) -> None:
        """Let all places keep as many rays, and owe as much training."""
        voxels = sum(region.size.evidence.voxels for region in self._regions.values())
        self._share = FairShare.of(voxels, self._settings.training)
        for region in self._regions.values():
            region.limit(self._share)
