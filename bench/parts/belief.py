"""What a map believes where things came and went, where it rains, and of what stands.

A voxel of a thing counts once rays of some later scans passed it: within ``_PASSED`` voxels of the
middle of the hits in it, and on beyond. So what no ray shows any more is nobody's fault.
"""

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.memory import memory_on
from triquad_server.intake.rays import usable_rays
from triquad_server.mapping.region_evidence import RegionEvidence
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
from triquad_server.settings.loading import load_settings
from triquad_tools.console.progress import progress
from triquad_tools.sensors.sweep import moved
from triquad_tools.simulation.scene import Scene

from bench.ended_voxels import NO_VOXEL, end_keys, voxel_centres, voxel_keys
from bench.scenes.episodes import STANDING, Episode, EpisodeScan, lies_on

PASSES = (3, 10, 30, 100)  # scans whose rays pass, after which a voxel is looked at
_PASSED = 0.3  # voxels: 6 cm where they are 0.2 m wide
_BEYOND_M = 0.5  # that such a ray goes on
_CLEAR_M = 0.35  # a voxel of a thing counts where nothing that stands is nearer
_LANE_AFTER = (10, 30)  # scans of the empty place after which its lane is looked at
_ROBOT_RADIUS_M = 0.35


@dataclass
class Seen:
    """What became of the voxels of an episode."""

    left: dict[str, dict[int, tuple[int, int]]] = field(default_factory=dict)
    """By thing and number of passing scans: voxels that are SURFACE still, of how many."""

    kept: dict[str, float] = field(default_factory=dict)  # share of what stands that is SURFACE
    blocked_m: dict[int, int] = field(default_factory=dict)  # of the lane, by empty scans


class Believed:
    """The evidence of a map alone, in one region: belief needs no field."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._setup = RegionSetup(
            field=settings.field,
            scan=settings.scan,
            change=settings.change,
            training=settings.training,
            memory=memory_on("cpu"),
            sums=GradientSums(),
            team=Teams().mapping,
        )
        self._region = RegionEvidence(self._setup, np.zeros(3), 0)

    def take_in(self, scan: EpisodeScan) -> None:
        """Take in a scan as a map does."""
        points = scan.points.astype(np.float32)
        rays = usable_rays(points, scan.world_from_sensor, self.settings.scan)
        seen = self._region.scan_seen(rays, 0)
        self._region.believe(seen)

    def is_surface(self, centres: Doubles) -> Bools:
        """Return whether voxels with ``centres`` [N, 3] are taken to be surface."""
        voxels = np.floor(self._region.voxels(centres)).astype(np.int64)
        return self._region.live.freeze().ended_in(voxels)

    def blocked_m(self, lane: Doubles) -> int:
        """Return how many of the ways ``lane`` [L, 2, 3], a metre each, a robot cannot go."""
        leaf_m, ball = self.settings.field.leaf_m, _ball(_ROBOT_RADIUS_M, self.settings)
        steps = np.linspace(0.0, 1.0, math.ceil(1.0 / leaf_m))
        ways = lane[:, :1] + steps[:, None] * (lane[:, 1:] - lane[:, :1])
        places = (ways[:, :, None] + ball).reshape(-1, 3)
        return int(self.is_surface(places).reshape(len(lane), -1).any(axis=1).sum())


def _ball(radius_m: float, settings: Settings) -> Doubles:
    """Return points [N, 3] of a ball about the origin, half a voxel apart."""
    step_m = 0.5 * settings.field.leaf_m
    reach = np.arange(-math.ceil(radius_m / step_m), math.ceil(radius_m / step_m) + 1) * step_m
    points = np.stack(np.meshgrid(reach, reach, reach), axis=-1).reshape(-1, 3)
    return np.asarray(points[np.linalg.norm(points, axis=1) <= radius_m])


def follow(episode: Episode) -> Seen:
    """Show an episode to a map, and look at what its things and rays have left."""
    believed = Believed(load_settings(preset=episode.preset))
    record = _Record(episode, believed.settings)
    seen = Seen()
    trails: list[_Trail] = []
    with progress(episode.name, len(episode)) as report:
        for number, scan in enumerate(episode, start=1):
            record.add(scan)
            believed.take_in(scan)
            empty = number - episode.busy_scans
            if empty == 0:
                trails = record.trails()
                seen.left |= {f"{one.name} amid it": {0: one.surface(believed)} for one in trails}
            if empty > 0 and any([trail.passed_by(scan) for trail in trails]):
                for trail in trails:
                    trail.look(believed)
            if empty in _LANE_AFTER:
                seen.blocked_m[empty] = believed.blocked_m(episode.lane)
            report(number, f"{number} of {len(episode)} scans")
    seen.left |= {trail.name: trail.left for trail in trails}
    seen.kept = record.kept(believed)
    return seen


class _Trail:
    """The voxels that a thing alone has left."""

    def __init__(self, name: str, centres: Doubles, middles: Doubles, voxel_m: float) -> None:
        """Begin with voxels of ``centres`` [N, 3], hit about ``middles`` [N, 3]; none is passed."""
        self.name = name
        self._within_m = _PASSED * voxel_m
        self.left: dict[int, tuple[int, int]] = {}
        self._centres, self._middles = centres, middles
        self._passes = np.zeros(len(centres), np.int64)
        self._due: Bools = np.zeros(len(centres), np.bool_)

    def passed_by(self, scan: EpisodeScan) -> bool:
        """Count a scan; return whether any voxel is to be looked at after it."""
        origin = scan.world_from_sensor[:3, 3]
        ends = moved(scan.points, scan.world_from_sensor) - origin
        passed = _passed(self._middles - origin, ends, self._within_m)
        self._passes[passed] += 1
        self._due = passed & np.isin(self._passes, PASSES)
        return bool(self._due.any())

    def surface(self, believed: Believed) -> tuple[int, int]:
        """Return how many of the voxels are SURFACE, and how many there are."""
        return int(believed.is_surface(self._centres).sum()), len(self._centres)

    def look(self, believed: Believed) -> None:
        """Look at the voxels that have just been passed by one of the numbers of scans."""
        is_surface = believed.is_surface(self._centres[self._due])
        for passes, surface in zip(self._passes[self._due].tolist(), is_surface, strict=True):
            before, count = self.left.get(passes, (0, 0))
            self.left[passes] = (before + int(surface), count + 1)


def _passed(middles: Doubles, ends: Doubles, within_m: float) -> Bools:
    """Return which places [N, 3] rays to ``ends`` [M, 3] pass; both are seen from the sensor."""
    ranges = np.linalg.norm(ends, axis=1)
    distances = np.linalg.norm(middles, axis=1)
    tree = cKDTree(ends / ranges[:, None])
    angles = within_m / np.maximum(distances, within_m)
    near = tree.query_ball_point(middles / distances[:, None], angles)
    farthest = np.array([ranges[rays].max(initial=0.0) for rays in near])
    return np.asarray(farthest > distances + _BEYOND_M)


class _Record:
    """The voxels in which rays ended amid things that come and go, by what they ended on."""

    def __init__(self, episode: Episode, settings: Settings) -> None:
        self._episode, self._settings = episode, settings
        self._on: dict[int, list[Longs]] = defaultdict(list)  # keys, scan by scan, by thing
        self._on_thin: list[Longs] = []
        self._hits: dict[int, list[Doubles]] = defaultdict(list)

    def add(self, scan: EpisodeScan) -> None:
        """Add a scan."""
        keys = end_keys(scan, self._settings)
        on_thin = np.zeros(len(scan.points), np.bool_)
        if self._episode.thin:
            bounds = self._episode.standing.scene.bounds
            on_thin = lies_on(Scene(self._episode.thin, bounds), scan.true_hits)
            self._on_thin.append(np.unique(keys[on_thin]))
        points = moved(scan.points, scan.world_from_sensor)
        for number in np.unique(scan.thing_of).tolist():
            chosen = (scan.thing_of == number) & ~on_thin
            self._on[number].append(np.unique(keys[chosen]))
            if number != STANDING:
                self._hits[number].append(points[chosen])

    def trails(self) -> list[_Trail]:
        """Return what the things alone have left so far."""
        standing, voxel_m = self._standing(), self._settings.field.leaf_m
        found = []
        for number, name in enumerate(self._episode.names):
            if number in self._on:
                keys = np.setdiff1d(_keys(self._on[number]), standing)
                centres = voxel_centres(keys, voxel_m)
                keys = keys[self._episode.standing.scene.sdf(centres) > _CLEAR_M]
                middles = _middles(keys, np.concatenate(self._hits[number]), voxel_m)
                found.append(_Trail(name, voxel_centres(keys, voxel_m), middles, voxel_m))
        return found

    def kept(self, believed: Believed) -> dict[str, float]:
        """Return the share of voxels that is SURFACE, of what stands and of thin things alone."""
        voxel_m = self._settings.field.leaf_m
        kept = {"static": _share(believed, voxel_centres(self._standing(), voxel_m))}
        if self._episode.thin:
            others = np.concatenate([_keys(parts) for parts in self._on.values()])
            alone = np.setdiff1d(_keys(self._on_thin), others)
            kept["thin things"] = _share(believed, voxel_centres(alone, voxel_m))
        return kept

    def _standing(self) -> Longs:
        return _keys([*self._on[STANDING], *self._on_thin])


def _keys(parts: list[Longs]) -> Longs:
    """Return the keys [N] of all voxels of some scans, sorted."""
    return np.setdiff1d(np.concatenate(parts), [NO_VOXEL])


def _share(believed: Believed, centres: Doubles) -> float:
    """Return the share of voxels that is surface; all, where there are none."""
    return float(believed.is_surface(centres).mean()) if len(centres) else 1.0


def _middles(keys: Longs, hits: Doubles, voxel_m: float) -> Doubles:
    """Return the mean [N, 3] of the ``hits`` [M, 3] in each of the voxels of sorted ``keys``."""
    of_hits = voxel_keys(hits, voxel_m)
    known = np.isin(of_hits, keys)
    rows = np.searchsorted(keys, of_hits[known])
    counts = np.maximum(np.bincount(rows, minlength=len(keys)), 1)
    sums = [np.bincount(rows, hits[known, axis], len(keys)) for axis in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]
