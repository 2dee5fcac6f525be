"""The evidence of rays in one region of the live map: voxels, surfels, and removed surface."""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Doubles, Ints, Longs
from triquad_format.records.region import Evidence
from triquad_map.compiled.voxel_index import empty_keys, thin
from triquad_map.evidence.carving import CLEAR_SHORT, FREE_SHORT, Reach
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting, first_seen_since
from triquad_map.evidence.ray_surfels import normals_at
from triquad_map.surface import SampleField, ShownByRays, nothing_shown
from triquad_map.surfels.surfel_map import SurfelMap, first_surfels

from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.region_setup import RegionSetup

_FAR_THINNED_AT, _OPEN_THINNED_AT = 0.5, 0.25  # shares of the rays' length

_LEAST_NORMALS = 500  # that a thread finds: half a millisecond

_SURFELS_REFITTED = 8_000
"""The number of surfels that are fitted again with each epoch while the field is trained: some
10 ms."""


class SeenScan(NamedTuple):
    """What a scan has shown."""

    rows: Ints  # [N] of the voxel in which each ray ended; 0 outside the region
    normals: Doubles  # [N, 3] of the surface where they ended, of either sign; NaN where unknown
    passed: Ints  # [P] of voxels that they may have crossed


class RegionEvidence:
    """The evidence of one region, and how it was published last."""

    def __init__(
        self, setup: RegionSetup, centre: Doubles, seed: int, record: Evidence | None = None
    ) -> None:
        """Restore the evidence of a record, or begin; ``centre`` [3] is the region's, map frame."""
        side = 1 << setup.field.depth
        self.live = LiveEvidence(side) if record is None else LiveEvidence.from_record(side, record)
        self._setup = setup
        self._centre = centre
        self._random = np.random.default_rng(seed)
        self._scans = 0  # scans in which the region was seen
        self._unlearnt_since = 1  # of these, the first since the field had learnt all
        self._scans_published = 0  # of these, those that the last epoch shows
        self._removed: list[Longs] = []  # voxels whose surface was removed since the last epoch
        self._surfels: SurfelMap | None = None  # of the last epoch
        self._fitted_to: int | None = None
        """The version of the field to which all surfels are fitted; None: some to earlier ones."""

        # Not yet published: only the field shows where surface lies.
        self._is_restored = record is not None

    def voxels(self, points: Doubles) -> Doubles:
        """Return the voxel coordinates [N, 3] of points [N, 3], map frame."""
        return self._setup.field.leaf_coordinates(points - self._centre)

    def scan_seen(self, rays: ScanRays, stamp_s: int) -> SeenScan:
        """Record where rays ended and what they crossed.

        ``stamp_s`` is when the scan was taken, seconds since 1970.
        """
        self._scans += 1
        ends, origin = self.voxels(rays.ends), self.voxels(rays.origin[None])[0]
        leaf_m = self._setup.field.leaf_m
        sighting = Sighting(origin, leaf_m, stamp_s, self._scans, self._unlearnt_since)
        rows = self.live.record_ends(ends, sighting, self._setup.team.split)
        normals = self.live.outdated_normals(rows, self._unlearnt_since)
        carve = partial(self._carved, rays, origin, ends)
        count = len(normals.rows)
        passed = self._setup.team.along(carve, count, normals.find, _LEAST_NORMALS)
        normals.finish()
        return SeenScan(rows, normals_at(ends, rows, self.live.observed), passed)

    def _carved(self, rays: ScanRays, origin: Doubles, ends: Doubles) -> Ints:
        """Record what the rays crossed; return the rows that they may have."""
        clear = math.inf if self._setup.change.static else CLEAR_SHORT
        reach = Reach(FREE_SHORT, clear, self._scans)
        thinned = ends[thin(ends, 1.0, empty_keys(len(ends)))]
        far_ends = self._thinned(origin, self.voxels(rays.far_ends), _FAR_THINNED_AT)
        passed = self.live.carve(origin, thinned, reach)
        passed_farther = self.live.carve(origin, far_ends, reach._replace(free=0.0))
        # Glass and black paint return nothing: these rays contradict no surface.
        open_ends = self._thinned(origin, self.voxels(rays.open_ends), _OPEN_THINNED_AT)
        self.live.carve(origin, open_ends, Reach(0.0))
        if rays.robot is not None:
            self.live.mark("free", self.voxels(rays.robot.voxel_centres(self._setup.field.leaf_m)))
        return np.concatenate([passed, passed_farther])

    def believe(self, seen: SeenScan) -> Longs:
        """Let surface come and go, after :meth:`scan_seen`; return the new voxels [M, 3]."""
        changes = self.live.believe(seen.rows, seen.passed)
        if len(changes.removed):
            self._removed.append(changes.removed)
        return changes.new

    def first_seen_within(self, scans: int, rows: Ints) -> Bools:
        """Return which rays [N] ended on a surface first seen in the last ``scans`` scans."""
        return first_seen_since(self._scans - scans + 1, rows, self.live.observed)

    def published(
        self, samples: SampleField, version: int, epoch: int, *, is_settled: bool
    ) -> tuple[FrozenEvidence, SurfelMap, Longs]:
        """Return the evidence as it is now, its surfels, and the voxels that lost their surface.

        These are the [M, 3] since the epoch before.

        Args:
            samples: the field, in voxels.
            version: of the field.
            epoch: number of the epoch that it is published with.
            is_settled: there is nothing to train on.
        """
        evidence = self.live.freeze(self._setup.team.split)
        self._surfels = surfels = self._fitted_surfels(
            evidence, samples, version, epoch, is_settled=is_settled
        )
        if is_settled and self._fitted_to != version:
            self._unlearnt_since = self._scans + 1
        self._fitted_to = version if is_settled else None
        self._scans_published = self._scans
        if self._is_restored:
            self.live.set_discs(surfels.voxels(), surfels.surfels)
            self._is_restored = False
        removed = np.unique(np.concatenate([np.zeros((0, 3), np.int64), *self._removed]), axis=0)
        self._removed.clear()
        if len(removed):
            removed = removed[~evidence.ended_in(removed)]  # nothing ended there since
        return evidence, surfels, removed

    def forget(self, low: Doubles, high: Doubles) -> None:
        """Forget what lies between two corners [3], map frame."""
        self.live.clear(self.voxels(low[None])[0], self.voxels(high[None])[0])

    def _thinned(self, origin: Doubles, ends: Doubles, share: float) -> Doubles:
        """Return some of the rays to ``ends`` [N, 3]: one per voxel at a share of their length.

        Nearer, they leave no gaps. The voxels are shifted from scan to scan, so that a robot at
        rest uses other rays each time.
        """
        near = origin + share * (ends - origin) + self._random.random(3)
        thinned: Doubles = ends[thin(near, 1.0, empty_keys(len(ends)))]
        return thinned

    def _fitted_surfels(
        self,
        evidence: FrozenEvidence,
        samples: SampleField,
        version: int,
        epoch: int,
        *,
        is_settled: bool,
    ) -> SurfelMap:
        """Return the surfels of an epoch; once the region has settled, all fitted to its field."""
        most: int | None = None
        shown: ShownByRays = nothing_shown
        if not is_settled or self._fitted_to == version:
            most = 0 if is_settled else _SURFELS_REFITTED
            shown = partial(self.live.ray_surfels, since=self._unlearnt_since)
        if self._surfels is None:
            return first_surfels(evidence, samples, epoch, shown)
        new = self._scans_published + 1
        return self._surfels.updated(evidence, samples, epoch, most, by_rays=shown, since=new)
