"""Records where each source of scans has been, and its newest scan, for viewers."""

import math
import threading
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles
from triquad_format.wire.limits import MAX_SAMPLE_POINTS
from triquad_format.wire.messages import Scan
from triquad_format.wire.source_messages import (
    NewestScan,
    ScanSource,
    SourceReport,
    SourcesRequest,
)

from triquad_server.intake.rays import ScanRays

_Float = TypeVar("_Float", bound=np.floating)

MAX_SOURCES = 256
"""The number of sources that are kept; the one heard of longest ago is removed."""

MAX_POSITIONS = 2048
"""The positions of a trail at most. Once it has that many, every second one is dropped, and from
then on they are twice as far apart: all of the way remains visible. They take as much of a reply as
the newest scan."""

_MOST_POINTS = 100_000
"""The points of the newest scans of all sources together, at most, in one reply."""

_JUMP_LEAVES = 250.0
"""A sensor that is farther away than this from one scan to the next has not moved there: 50 m with
the leaf of streets, where a car does 14 m a second and some of its scans may be lost."""

_DRAWS = np.random.default_rng(0).random(MAX_SAMPLE_POINTS)
"""The point of each run that is taken, always the same: drawing it each time takes longer."""


class _Place(NamedTuple):
    """A place of a sensor on its trail."""

    position: tuple[float, float, float]  # metres, map frame
    piece: int  # rises where the sensor jumped


@dataclass
class _Source:
    """The trail and the newest scan of one source."""

    spacing_m: float  # of the trail's places
    scans: int = 0
    newest: NewestScan | None = None
    trail: list[_Place] = field(default_factory=list)  # oldest first
    corrections: int = 0  # of the trail

    @property
    def positions(self) -> Doubles:
        """The positions [N, 3] of the trail."""
        places = [place.position for place in self.trail]
        return np.array(places, np.float64).reshape(-1, 3)

    def add(self, taken: NewestScan, jump_m: float) -> None:
        """Add the source's newest scan."""
        position = _position(taken)
        jumped = self.newest is None or math.dist(position, _position(self.newest)) > jump_m
        self.scans += 1
        self.newest = taken
        self._go(position, jumped=jumped)

    def retrace(self, poses: Doubles, jump_m: float) -> None:
        """Have been at poses [N, 4, 4], one after the other and the newest scan last."""
        self.corrections += 1
        if (newest := self.newest) is not None:
            turn = poses[-1, :3, :3] @ newest.world_from_sensor[:3, :3].T
            points = (newest.points @ turn.T).astype(np.float32)
            self.newest = replace(newest, world_from_sensor=poses[-1], points=points)
        self.trail.clear()
        positions = poses[:, :3, 3]
        steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        for position, step_m in zip(positions, [0.0, *steps_m.tolist()], strict=True):
            self._go(position, jumped=step_m > jump_m)

    def _go(self, position: Doubles, *, jumped: bool) -> None:
        piece = 0
        if self.trail:
            last = self.trail[-1]
            if not jumped and math.dist(position, last.position) < self.spacing_m:
                return
            piece = last.piece + jumped
        if len(self.trail) == MAX_POSITIONS:
            del self.trail[1::2]
            self.spacing_m *= 2.0
        x, y, z = position.tolist()
        self.trail.append(_Place((x, y, z), piece))

    def forget(self, minimum: Doubles, maximum: Doubles) -> None:
        """Forget where the source has been within a box; the trail is interrupted there.

        Its newest scan is forgotten where it, or the last of the trail, lies in the box.
        """
        inside = _within(self.positions, minimum, maximum)
        if self.newest is not None:
            here = _within(_position(self.newest)[None], minimum, maximum)
            if here.any() or inside[-1:].any():
                self.newest = None
        gaps = np.cumsum(inside).tolist()
        self.trail = [
            place._replace(piece=place.piece + gaps[row])
            for row, place in enumerate(self.trail)
            if not inside[row]
        ]

    def state(self, max_points: int) -> ScanSource:
        """Return the source as it is sent, with at most ``max_points`` of its newest scan."""
        newest = self.newest
        if newest is not None:
            newest = replace(newest, points=evenly(newest.points, max_points))
        pieces = np.array([place.piece for place in self.trail], np.int64)
        return ScanSource(self.scans, self.positions, pieces, newest, self.corrections)


class SourceTrails:
    """Keeps where each source has been, and its newest scan; one thread adds, any may query."""

    def __init__(self, leaf_m: float, server: str = "") -> None:
        """Begin with positions of a trail a leaf apart; ``server`` is the name in replies."""
        self._server = server
        self._spacing_m = leaf_m
        self._jump_m = _JUMP_LEAVES * leaf_m
        self._lock = threading.Lock()
        self.revision = 0  # rises with each change
        self._sources: OrderedDict[str, _Source] = OrderedDict()  # the one heard of last is last

    def add(self, scan: Scan, rays: ScanRays) -> None:
        """Record that a scan was taken into the map; ``rays`` are what of it is used."""
        points = evenly(rays.ends, MAX_SAMPLE_POINTS) - scan.world_from_sensor[:3, 3]
        with self._lock:
            self.revision += 1
            source = self._sources.pop(scan.source, None) or _Source(self._spacing_m)
            self._sources[scan.source] = source
            if len(self._sources) > MAX_SOURCES:
                self._sources.popitem(last=False)
            taken = NewestScan(
                scan.stamp_ns,
                scan.world_from_sensor,
                points=points.astype(np.float32),
                points_used=len(rays.ends),
            )
            source.add(taken, self._jump_m)

    def forget(self, minimum: Doubles, maximum: Doubles) -> None:
        """Forget what lies between two corners [3], metres, map frame."""
        with self._lock:
            self.revision += 1
            for name, source in list(self._sources.items()):
                source.forget(minimum, maximum)
                if source.newest is None and not source.trail:
                    del self._sources[name]

    def retrace(self, name: str, poses: Doubles) -> None:
        """Have a source been at poses [N, 4, 4], map frame, which were corrected."""
        with self._lock:
            self.revision += 1
            if (source := self._sources.get(name)) is not None:
                source.retrace(poses, self._jump_m)

    def answer(self, request: SourcesRequest) -> SourceReport:
        """Return all sources, if anything of them is new since the reply before."""
        with self._lock:
            if (request.server, request.revision) == (self._server, self.revision):
                return SourceReport(self._server, self.revision, {})
            most = min(request.max_points, _MOST_POINTS // max(1, len(self._sources)))
            sources = {name: source.state(most) for name, source in self._sources.items()}
            return SourceReport(self._server, self.revision, sources)


def _position(taken: NewestScan) -> Doubles:
    """Return where the sensor was: [3] metres, map frame."""
    return taken.world_from_sensor[:3, 3]


def evenly(points: NDArray[_Float], count: int) -> NDArray[_Float]:
    """Return at most ``count`` of the points [N, 3]: one of each of as many runs of them.

    Which one of a run is drawn: every tenth, say, may be of one laser of a lidar.
    """
    if len(points) <= count:
        return points
    runs = np.arange(count + 1) * len(points) // max(count, 1)
    chosen = runs[:-1] + (_DRAWS[:count] * np.diff(runs)).astype(np.int64)
    return points.take(chosen, axis=0)


def _within(positions: Doubles, minimum: Doubles, maximum: Doubles) -> Bools:
    """Return whether each of the positions [N, 3] lies between two corners [3]."""
    return np.asarray(((positions >= minimum) & (positions <= maximum)).all(axis=1))
