"""Records where each source of scans has been, and its newest scan, for viewers."""

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Bools, Doubles
from triquad_format.wire.limits import MAX_SAMPLE_POINTS
from triquad_format.wire.messages import Scan
from triquad_format.wire.query_messages import ScanSample, SourceState

from triquad_server.intake.rays import ScanRays

MAX_SOURCES = 256
"""The number of sources that are kept; the one heard of longest ago is removed."""

MAX_POSITIONS = 8192
"""The positions of a trail at most. Once it has that many, every second one is dropped, and from
then on they are twice as far apart: all of the way remains visible."""

_JUMP_LEAVES = 250.0
"""A sensor that is farther away than this from one scan to the next has not moved there: 50 m with
the leaf of streets, where a car does 14 m a second and some of its scans may be lost."""

_DRAWS = np.random.default_rng(0).random(MAX_SAMPLE_POINTS)
"""The point of each run that is taken, always the same: drawing it each time takes longer."""


@dataclass(frozen=True)
class TakenScan:
    """A scan that was taken into the map."""

    stamp_ns: int
    world_from_sensor: Doubles  # [4, 4]
    points: Doubles  # [N, 3] metres, map frame: those that are used, or some of them
    points_used: int
    revision: int

    @property
    def position(self) -> Doubles:
        """Return where the sensor was: [3] metres, map frame."""
        return self.world_from_sensor[:3, 3]

    def sample(self, max_points: int) -> ScanSample:
        """Return the scan as it is sent, with at most ``max_points``."""
        return ScanSample(
            stamp_ns=self.stamp_ns,
            world_from_sensor=self.world_from_sensor,
            points=(evenly(self.points, max_points) - self.position).astype(np.float32),
            points_used=self.points_used,
        )


class _Place(NamedTuple):
    """A place of a sensor on its trail."""

    position: tuple[float, float, float]  # metres, map frame
    piece: int  # rises where the sensor jumped
    revision: int


@dataclass
class _Source:
    """The trail and the newest scan of one source."""

    rewritten: int  # revision since which the trail was only added to
    spacing_m: float  # of the trail's places
    scans: int = 0
    newest: TakenScan | None = None
    trail: list[_Place] = field(default_factory=list)  # oldest first

    @property
    def positions(self) -> Doubles:
        """The positions [N, 3] of the trail."""
        return _positions(self.trail)

    def add(self, taken: TakenScan, jump_m: float) -> None:
        """Add the source's newest scan."""
        jumped = self.newest is None or math.dist(taken.position, self.newest.position) > jump_m
        self.scans += 1
        self.newest = taken
        piece = 0
        if self.trail:
            last = self.trail[-1]
            if not jumped and math.dist(taken.position, last.position) < self.spacing_m:
                return
            piece = last.piece + jumped
        if len(self.trail) == MAX_POSITIONS:
            del self.trail[1::2]
            self.spacing_m *= 2.0
            self.rewritten = taken.revision
        x, y, z = taken.position.tolist()
        self.trail.append(_Place((x, y, z), piece, taken.revision))

    def forget(self, minimum: Doubles, maximum: Doubles, revision: int) -> None:
        """Forget where the source has been within a box; the trail is interrupted there.

        Its newest scan is forgotten where it, or the last of the trail, lies in the box.
        """
        inside = _within(self.positions, minimum, maximum)
        newest = self.newest
        if newest is not None:
            here = _within(newest.position[None], minimum, maximum)
            if here.any() or inside[-1:].any():
                self.newest = None
        if inside.any() or newest is not self.newest:
            gaps = np.cumsum(inside).tolist()
            self.trail = [
                place._replace(piece=place.piece + gaps[row])
                for row, place in enumerate(self.trail)
                if not inside[row]
            ]
            self.rewritten = revision

    def newer(self, revision: int) -> TakenScan | None:
        """Return the newest scan, if it is not known since a revision."""
        is_known = self.newest and self.newest.revision <= revision and self.rewritten <= revision
        return None if is_known else self.newest

    def delta(self, revision: int, max_points: int) -> SourceState:
        """Return the changes since a revision, with at most ``max_points`` of the newest scan."""
        whole = self.rewritten > revision
        new = [place for place in self.trail if whole or place.revision > revision]
        newest = self.newer(revision)
        return SourceState(
            self.scans,
            whole,
            trail=_positions(new),
            pieces=np.array([place.piece for place in new], np.int64),
            newest=None if newest is None else newest.sample(max_points),
        )


class SourceTrails:
    """Keeps where each source has been, and its newest scan; one thread adds, any may query."""

    def __init__(self, leaf_m: float) -> None:
        """Begin with positions of a trail a leaf apart."""
        self._spacing_m = leaf_m
        self._jump_m = _JUMP_LEAVES * leaf_m
        self._lock = threading.Lock()
        self._revision = 0
        self._sources: OrderedDict[str, _Source] = OrderedDict()  # the one heard of last is last

    def add(self, scan: Scan, rays: ScanRays) -> None:
        """Record that a scan was taken into the map; ``rays`` are what of it is used."""
        points = evenly(rays.ends, MAX_SAMPLE_POINTS)
        with self._lock:
            self._revision += 1
            source = self._sources.pop(scan.source, None)
            if source is None:
                source = _Source(rewritten=self._revision, spacing_m=self._spacing_m)
            self._sources[scan.source] = source
            if len(self._sources) > MAX_SOURCES:
                self._sources.popitem(last=False)
            taken = TakenScan(
                scan.stamp_ns,
                scan.world_from_sensor,
                points=points,
                points_used=len(rays.ends),
                revision=self._revision,
            )
            source.add(taken, self._jump_m)

    def forget(self, minimum: Doubles, maximum: Doubles) -> None:
        """Forget what lies between two corners [3], metres, map frame."""
        with self._lock:
            self._revision += 1
            for name, source in list(self._sources.items()):
                source.forget(minimum, maximum, self._revision)
                if source.newest is None and not source.trail:
                    del self._sources[name]

    def since(
        self, revision: int, max_points: int = 0, max_points_in_all: int = 0
    ) -> tuple[int, dict[str, SourceState]]:
        """Return the revision now, and the changes of every source since an earlier one.

        Newest scans have at most ``max_points`` each, and all together ``max_points_in_all``.
        """
        with self._lock:
            new = sum(source.newer(revision) is not None for source in self._sources.values())
            most = min(max_points, max_points_in_all // max(1, new))
            states = {name: one.delta(revision, most) for name, one in self._sources.items()}
            return self._revision, states


def evenly(points: Doubles, count: int) -> Doubles:
    """Return at most ``count`` of the points [N, 3]: one of each of as many runs of them.

    Which one of a run is drawn: every tenth, say, may be of one laser of a lidar.
    """
    if len(points) <= count:
        return points
    runs = np.arange(count + 1) * len(points) // max(count, 1)
    chosen = runs[:-1] + (_DRAWS[:count] * np.diff(runs)).astype(np.int64)
    return points.take(chosen, axis=0)


def _positions(places: list[_Place]) -> Doubles:
    """Return the positions [N, 3] of places."""
    return np.array([place.position for place in places], np.float64).reshape(-1, 3)


def _within(positions: Doubles, minimum: Doubles, maximum: Doubles) -> Bools:
    """Return whether each of the positions [N, 3] lies between two corners [3]."""
    return np.asarray(((positions >= minimum) & (positions <= maximum)).all(axis=1))
