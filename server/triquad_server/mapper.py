"""The live map: takes in scans, trains, publishes epochs. Owned by one thread."""

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from triquad_format.region import MapRecord, RegionIndex

from triquad_server.engine import GradientSums
from triquad_server.epoch import Epoch, FrozenRegion, frozen_region
from triquad_server.normals import SurfaceNormals
from triquad_server.region_map import RegionMap
from triquad_server.sampling import draw_samples
from triquad_server.scan import IngestReport, ScanRefusedError, usable_rays
from triquad_server.settings import Settings

_LOSS_MEMORY = 0.95


class Mapper:
    """A map that grows and learns. It knows no files and no clocks."""

    def __init__(
        self,
        name: str,
        settings: Settings,
        device: str,
        record: MapRecord | None = None,
    ) -> None:
        self._name = name
        self._settings = settings
        self._field_settings = record.settings if record else settings.field
        self._device = torch.device(device)
        if self._device.type == "cpu":
            # Its threads spin between operations, and would take the cores from the kernels.
            torch.set_num_threads(1)
        self._rng = np.random.default_rng(settings.training.seed)
        self._normals = SurfaceNormals()
        self._sums = GradientSums()
        self._regions: dict[RegionIndex, RegionMap] = {}
        self._number = record.epoch if record else 0
        self._epoch: Epoch | None = None
        self._structure_changed = True
        self.samples_trained = 0
        self.loss = 0.0
        for region in record.regions if record else ():
            self._regions[region.index] = RegionMap.restore(
                region,
                self._field_settings,
                settings.training,
                self._device,
                self._sums,
            )
        self._share_pool()

    @property
    def settled(self) -> bool:
        """Whether nothing is left to learn from the scans so far."""
        return not any(region.owed for region in self._regions.values())

    @property
    def samples_kept(self) -> int:
        """Samples in the replay pools."""
        return sum(len(region.pool) for region in self._regions.values())

    def ingest(
        self,
        points: NDArray[np.float32],
        world_from_sensor: NDArray[np.float64],
    ) -> IngestReport:
        """Take in a scan: ``points`` [N, 3] in metres of the sensor frame, pose [4, 4].

        Raises:
            ScanRefusedError: the scan cannot be used; the map is unchanged.
        """
        rays = usable_rays(points, world_from_sensor, self._settings.scan)
        around = self._regions_around(rays.ends)
        self._check_regions(around)
        self._normals.add(rays.ends, rays.origin)
        normals = self._normals.at(rays.ends)
        samples = draw_samples(rays, normals, self._settings.scan, self._rng)
        for index in around:
            self._region(index).take_in(rays, samples)
        return rays.report

    def train(self) -> None:
        """One optimiser step in the region that owes the most; nothing where all is settled."""
        region = max(self._regions.values(), key=lambda region: region.owed, default=None)
        if region is None or region.owed == 0:
            return
        loss = region.train()
        self.loss = _LOSS_MEMORY * self.loss + (1 - _LOSS_MEMORY) * loss if self.loss else loss
        self.samples_trained += self._settings.training.batch

    def publish(self) -> Epoch:
        """The newest epoch: a new one where the map changed since the last."""
        changed = self._structure_changed or any(r.changed for r in self._regions.values())
        if self._epoch is not None and not changed:
            return self._epoch
        if self._epoch is not None or not self._number:
            self._number += 1
        before = (
            {region.index: region for region in self._epoch.frozen_regions} if self._epoch else {}
        )
        regions = tuple(self._freeze(region, before) for region in self._regions.values())
        self._epoch = Epoch(
            self._name,
            self._number,
            self._field_settings,
            self._settings.mesh,
            regions,
        )
        self._structure_changed = False
        return self._epoch

    def reset(self, minimum: NDArray[np.float64], maximum: NDArray[np.float64]) -> None:
        """Forget what lies between two corners [3]; regions wholly between them disappear."""
        half = self._field_settings.region_side_m / 2
        for index, region in list(self._regions.items()):
            low, high = region.centre - half, region.centre + half
            if ((minimum <= low) & (maximum >= high)).all():
                del self._regions[index]
            elif ((minimum < high) & (maximum > low)).all():
                region.forget(np.maximum(minimum, low), np.minimum(maximum, high))
        self._normals.forget(minimum, maximum)
        self._share_pool()
        self._structure_changed = True

    def record(self, training: bool) -> MapRecord:
        """The live map as plain arrays, sharing nothing with it."""
        regions = tuple(region.record(training) for region in self._regions.values())
        return MapRecord(self._name, self.publish().number, self._field_settings, regions)

    def _freeze(
        self,
        region: RegionMap,
        before: dict[RegionIndex, FrozenRegion],
    ) -> FrozenRegion:
        """The region as it is now; the last frozen one where it did not change since."""
        if not region.changed and region.index in before:
            return before[region.index]
        region.changed = False
        return frozen_region(
            region.index,
            self._field_settings,
            region.field,
            region.evidence,
            self._number,
        )

    def _regions_around(self, points: NDArray[np.float64]) -> list[RegionIndex]:
        """Regions whose cubes hold any of the points."""
        pitch = self._field_settings.region_pitch_m
        half = self._field_settings.region_side_m / 2
        low = np.ceil((points.min(axis=0) - half) / pitch).astype(int)
        high = np.floor((points.max(axis=0) + half) / pitch).astype(int)
        x, y, z = (range(first, last + 1) for first, last in zip(low, high, strict=True))
        return [
            index
            for index in itertools.product(x, y, z)
            if (np.abs(points - np.multiply(index, pitch)) < half).all(axis=1).any()
        ]

    def _check_regions(self, wanted: list[RegionIndex]) -> None:
        limit = self._settings.training.max_regions
        count = len(self._regions.keys() | set(wanted))
        if count > limit:
            raise ScanRefusedError(
                "too_many_regions",
                f"the scan would make {count} regions of the map, more than "
                f"training.max_regions = {limit}",
            )

    def _region(self, index: RegionIndex) -> RegionMap:
        if index not in self._regions:
            self._regions[index] = RegionMap(
                index,
                self._field_settings,
                self._settings.training,
                self._device,
                self._sums,
            )
            self._share_pool()
            self._structure_changed = True
        return self._regions[index]

    def _share_pool(self) -> None:
        """Give every region an equal part of the replay samples that may be kept."""
        share = max(1, self._settings.training.pool_samples // max(1, len(self._regions)))
        for region in self._regions.values():
            region.pool.limit(share)
