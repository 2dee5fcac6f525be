"""What a map believes where things came and went, where it rains, and of what stands.

A voxel of a thing counts once rays of some later scans passed it: within ``_PASSED_M`` of the
middle of the hits in it, and on beyond. So what no ray shows any more is nobody's fault.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.status import Status
from triquad_map.questions.segments import SegmentOptions, segments
from triquad_server.epochs.epoch import Epoch
from triquad_server.settings import Settings
from triquad_tools.console.progress import progress
from triquad_tools.sensors.sweep import moved

from bench.ended_voxels import EndedVoxels, end_keys, surface_share, voxel_centres, voxel_keys
from bench.figures import Figure
from bench.scenes.episodes import STANDING, Episode, EpisodeScan
from bench.scenes.known_episodes import held_episodes, tuned_episodes
from bench.street import StreamedMap

PASSES = (3, 10, 30, 100)  # scans whose rays pass, after which a voxel is looked at
_PASSED_M = 0.06
_BEYOND_M = 0.5  # that such a ray goes on
_CLEAR_M = 0.35  # a voxel of a thing counts where nothing that stands is nearer
_LANE_AFTER = 10  # scans of the empty place after which its lane is looked at
_ROBOT = SegmentOptions(radius_m=0.4, max_distance_m=1.0)


def measure_belief(scans: int, *, held: bool) -> list[Figure]:
    """Return figures of all episodes, with ``scans`` scans of each place when it is empty."""
    episodes = held_episodes(scans) if held else tuned_episodes(scans)
    return [figure for episode in episodes for figure in _figures(episode)]


def _figures(episode: Episode) -> Iterator[Figure]:
    seen = follow(episode)
    for name, left in seen.left.items():
        for passes, (surface, count) in sorted(left.items()):
            title = f"{episode.name}: {name}, SURFACE after {passes} scans that pass ({count})"
            yield Figure(title, 100 * surface / max(count, 1), "%")
    yield Figure(f"{episode.name}: lane blocked after {_LANE_AFTER}", seen.blocked_m, "m")
    for what, share in seen.kept.items():
        yield Figure(f"{episode.name}: {what} lost", 100 * (1 - share), "%")


@dataclass
class Seen:
    """What became of the voxels of an episode."""

    left: dict[str, dict[int, tuple[int, int]]] = field(default_factory=dict)
    """By thing and number of passing scans: voxels that are SURFACE still, of how many."""

    kept: dict[str, float] = field(default_factory=dict)  # share of what stands that is SURFACE
    blocked_m: int = 0


def follow(episode: Episode, settings: Settings | None = None) -> Seen:
    """Map an episode as a server does, and look at what its things and rays have left."""
    streamed = StreamedMap(settings or Settings())
    record = _Record(episode, streamed.settings)
    seen = Seen()
    trails: list[_Trail] = []
    with progress(episode.name, len(episode)) as report:
        for number, scan in enumerate(episode, start=1):
            record.add(scan)
            streamed.take_in(scan)
            empty = number - episode.busy_scans
            if empty == 0:
                epoch = streamed.mapper.publish()
                trails = record.trails(epoch)
                seen.left |= {
                    f"{trail.name} amid it": {0: trail.surface(epoch)} for trail in trails
                }
            if empty > 0 and any([trail.passed_by(scan) for trail in trails]):
                epoch = streamed.mapper.publish()
                for trail in trails:
                    trail.look(epoch)
            if empty == _LANE_AFTER:
                seen.blocked_m = _blocked_m(streamed.mapper.publish(), episode.lane)
            report(number, f"{number} of {len(episode)} scans")
    seen.left |= {trail.name: trail.left for trail in trails}
    seen.kept = record.kept(streamed.mapper.publish())
    return seen


def _blocked_m(epoch: Epoch, lane: Doubles) -> int:
    return int(segments(epoch, lane[:, 0], lane[:, 1], _ROBOT).blocked.sum())


class _Trail:
    """The voxels that a thing alone has left."""

    def __init__(self, name: str, centres: Doubles, middles: Doubles) -> None:
        """Begin with voxels of ``centres`` [N, 3], hit about ``middles`` [N, 3]; none is passed."""
        self.name = name
        self.left: dict[int, tuple[int, int]] = {}
        self._centres, self._middles = centres, middles
        self._passes = np.zeros(len(centres), np.int64)
        self._due: Bools = np.zeros(len(centres), np.bool_)

    def passed_by(self, scan: EpisodeScan) -> bool:
        """Count a scan; return whether any voxel is to be looked at after it."""
        origin = scan.world_from_sensor[:3, 3]
        passed = _passed(
            self._middles - origin, moved(scan.points, scan.world_from_sensor) - origin
        )
        self._passes[passed] += 1
        self._due = passed & np.isin(self._passes, PASSES)
        return bool(self._due.any())

    def surface(self, epoch: Epoch) -> tuple[int, int]:
        """Return how many of the voxels are SURFACE, and how many there are."""
        return round(len(self._centres) * surface_share(epoch, self._centres)), len(self._centres)

    def look(self, epoch: Epoch) -> None:
        """Look at the voxels that have just been passed by one of the numbers of scans."""
        is_surface = epoch.status(self._centres[self._due], reach_m=0.0) == Status.SURFACE
        for passes, surface in zip(self._passes[self._due].tolist(), is_surface, strict=True):
            before, count = self.left.get(passes, (0, 0))
            self.left[passes] = (before + int(surface), count + 1)


def _passed(middles: Doubles, ends: Doubles) -> Bools:
    """Return which places [N, 3] rays to ``ends`` [M, 3] pass; both are seen from the sensor."""
    ranges = np.linalg.norm(ends, axis=1)
    distances = np.linalg.norm(middles, axis=1)
    tree = cKDTree(ends / ranges[:, None])
    near = tree.query_ball_point(
        middles / distances[:, None], _PASSED_M / np.maximum(distances, _PASSED_M)
    )
    farthest = np.array([ranges[rays].max(initial=0.0) for rays in near])
    return np.asarray(farthest > distances + _BEYOND_M)


class _Record:
    """The voxels in which rays ended amid things that come and go, by what they ended on."""

    def __init__(self, episode: Episode, settings: Settings) -> None:
        self._episode, self._settings = episode, settings
        self._names = episode.names
        self._on: dict[int, EndedVoxels] = defaultdict(EndedVoxels)
        self._on_thin = EndedVoxels()
        self._hits: dict[int, list[Doubles]] = defaultdict(list)

    def add(self, scan: EpisodeScan) -> None:
        """Add a scan."""
        keys = end_keys(scan, self._settings)
        on_thin: Any = False
        if self._episode.thin:
            scene = type(self._episode.standing.scene)(
                self._episode.thin, self._episode.standing.scene.bounds
            )
            on_thin = np.abs(scene.sdf(scan.true_hits)) < 1e-6
            self._on_thin.add(keys[on_thin])
        points = moved(scan.points, scan.world_from_sensor)
        for number in np.unique(scan.thing_of).tolist():
            chosen = (scan.thing_of == number) & ~on_thin
            self._on[number].add(keys[chosen])
            if number != STANDING:
                self._hits[number].append(points[chosen])

    def trails(self, epoch: Epoch) -> list[_Trail]:
        """Return what the things alone have left so far."""
        standing = self._standing()
        found = []
        for number, name in enumerate(self._names):
            if number in self._on:
                keys = np.setdiff1d(self._on[number].keys(), standing)
                centres = voxel_centres(keys, epoch.voxel_m)
                keys = keys[self._episode.standing.scene.sdf(centres) > _CLEAR_M]
                middles = _middles(keys, np.concatenate(self._hits[number]), epoch.voxel_m)
                found.append(_Trail(name, voxel_centres(keys, epoch.voxel_m), middles))
        return found

    def kept(self, epoch: Epoch) -> dict[str, float]:
        """Return the share of voxels that is SURFACE, of what stands and of thin things alone."""
        voxel_m = epoch.voxel_m
        kept = {"static": surface_share(epoch, voxel_centres(self._standing(), voxel_m))}
        if self._episode.thin:
            others = np.concatenate([one.keys() for one in self._on.values()])
            alone = np.setdiff1d(self._on_thin.keys(), others)
            kept["thin things"] = surface_share(epoch, voxel_centres(alone, voxel_m))
        return kept

    def _standing(self) -> Longs:
        standing = self._on[STANDING].keys()
        return np.union1d(standing, self._on_thin.keys()) if self._episode.thin else standing


def _middles(keys: Longs, hits: Doubles, voxel_m: float) -> Doubles:
    """Return the mean [N, 3] of the ``hits`` [M, 3] in each of the voxels of sorted ``keys``."""
    of_hits = voxel_keys(hits, voxel_m)
    known = np.isin(of_hits, keys)
    rows = np.searchsorted(keys, of_hits[known])
    counts = np.maximum(np.bincount(rows, minlength=len(keys)), 1)
    sums = [np.bincount(rows, hits[known, axis], len(keys)) for axis in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]
