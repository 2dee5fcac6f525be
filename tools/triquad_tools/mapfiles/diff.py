"""The differences of two maps, in figures and as objects; ``docs/tools.md`` defines all of them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bytes, Doubles, Floats
from triquad_format.records.status import Status
from triquad_map.clusters import clusters

from triquad_tools.console.command import print_line
from triquad_tools.console.report import print_columns

if TYPE_CHECKING:  # slow to import
    from triquad_client import OfflineMap

NEAR_ENOUGH_M = 1e-4  # a point this near to the zero of the field is on the surface
STILL_M = 1e-3  # the least movement that counts: several times the error of a surface point
NOISE_M = 0.02  # two maps that learnt the same differ by less, but for single points
_TOUCHING_LEAVES = 2  # along each axis, as far as points of one object may be apart
_OTHER_FRAME = 0.2
"""The share of the surface of both maps that is free in the other above which it is asked whether
their frames differ: in two frames it was 0.37 and 0.5 (a recorded road)."""

_STEPS = 8
_LEAST_SLOPE = 0.1  # a flatter field says nothing of where its zero is

LEAST_POINTS = 20
"""Clusters of fewer surface points are left out: noise makes them, too. These are 0.8 square metres
of surface in leaves of 0.2 m."""

_LISTED = 5  # clusters of a kind, at most: of two drives dozens of places moved by 2 cm


@dataclass(frozen=True)
class Sighting:
    """Surface points of one map, and what the other map says of them."""

    points: Doubles  # [N, 3] metres, map frame
    sdf: Floats  # [N] metres; NaN where the other map has nothing
    status: Bytes  # [N] triquad_format.records.status.Status
    leaf_m: float  # of the map whose surface it is

    def part(self, rows: NDArray[np.intp]) -> "Sighting":
        """Return some of the points."""
        return Sighting(self.points[rows], self.sdf[rows], self.status[rows], leaf_m=self.leaf_m)

    def having(self, status: Status) -> "Sighting":
        """Return the points of which the other map says ``status``."""
        return self.part(np.flatnonzero(self.status == status))


@dataclass(frozen=True)
class Comparison:
    """Two maps A and B, seen from each other."""

    old: Sighting  # surface of A, asked in B
    new: Sighting  # surface of B, asked in A

    @property
    def changed(self) -> dict[str, Sighting]:
        """The surface points that are not in both maps, or not where they were, by kind."""
        vanished, hidden = self.old.having(Status.FREE), self.old.having(Status.UNKNOWN)
        return {
            "vanished": vanished,
            "appeared": self.new.having(Status.FREE),
            "newly_seen": self.new.having(Status.UNKNOWN),
            "no_longer_known": hidden,
            "moved": self._moved(np.concatenate([vanished.points, hidden.points])),
        }

    def _moved(self, gone: Doubles) -> Sighting:
        """Return points of A that B has elsewhere, but not those next to what is ``gone`` [N, 3].

        The surface next to a thing that came or went is near the surface of that, too.
        """
        from scipy.spatial import cKDTree  # slow to import

        near = self.old.having(Status.SURFACE)
        moved = near.part(np.flatnonzero(np.abs(near.sdf) > NOISE_M))
        touching_m = _TOUCHING_LEAVES * moved.leaf_m
        away_m = cKDTree(gone).query(moved.points, p=np.inf, distance_upper_bound=touching_m)[0]
        return moved.part(np.flatnonzero(np.isinf(away_m)))


@dataclass(frozen=True)
class Change:
    """The difference of the surface between maps A and B; counts are of points."""

    points_a: int
    points_b: int
    appeared: int  # of B: A has seen free space there
    vanished: int  # of A: B has seen free space there
    newly_seen: int  # of B: A has seen nothing there
    no_longer_known: int  # of A: B has seen nothing there
    moved: int  # of A: B has it near its surface, but more than NOISE_M elsewhere
    moved_median_m: float  # of the points of A that B has near its surface; NaN if there are none
    moved_p95_m: float

    @property
    def differs(self) -> bool:
        """Whether there is any difference to report."""
        only_in_one = self.appeared or self.vanished or self.newly_seen or self.no_longer_known
        return bool(only_in_one or self.moved) or self.moved_p95_m >= STILL_M


@dataclass(frozen=True)
class Cluster:
    """Surface points that lie together, and the box around them."""

    low_m: tuple[float, ...]  # [3] map frame
    high_m: tuple[float, ...]  # [3]
    points: int

    @property
    def middle_m(self) -> Doubles:
        """[3] of the box."""
        return np.add(self.low_m, self.high_m) / 2

    @property
    def size_m(self) -> Doubles:
        """[3] of the box, along the axes."""
        return np.subtract(self.high_m, self.low_m)


def compare(a: "OfflineMap", b: "OfflineMap") -> Comparison:
    """Return the surface of each of two maps, asked in the other."""
    return Comparison(_sighting(a, b), _sighting(b, a))


def difference(comparison: Comparison) -> Change:
    """Return the figures of a comparison."""
    old, new = comparison.old, comparison.new
    counts = {kind: len(found.points) for kind, found in comparison.changed.items()}
    moved = np.abs(old.having(Status.SURFACE).sdf).astype(np.float64)
    median, p95 = np.quantile(moved, [0.5, 0.95]) if len(moved) else (np.nan, np.nan)
    return Change(
        points_a=len(old.points),
        points_b=len(new.points),
        **counts,
        moved_median_m=float(median),
        moved_p95_m=float(p95),
    )


def surface_points(opened: "OfflineMap") -> Doubles:
    """Return points ``[N, 3]`` where the field is zero, at most one per voxel where rays ended.

    The middles of these voxels are moved along the gradient by Newton's method. Those that have
    not come to a zero within a voxel's diagonal, and to one where the mesh may have faces, are left
    out: away from where rays ended the field may cross zero anywhere.
    """
    leaf_m = opened.leaf_m
    middles = opened.surface_voxels()
    points = middles.copy()
    arrived = np.zeros(len(points), np.bool_)
    under_way = np.arange(len(points))
    for _ in range(_STEPS):
        answer = opened.query_sdf(points[under_way], gradient=True)
        there = np.abs(answer.sdf) <= NEAR_ENOUGH_M
        arrived[under_way[there]] = True
        sdf, gradient, under_way = answer.sdf[~there], answer.gradient[~there], under_way[~there]
        slope = np.maximum(np.linalg.norm(gradient, axis=1), _LEAST_SLOPE)
        length = np.minimum(np.abs(sdf) / slope, leaf_m / 2)
        points[under_way] += (-np.sign(sdf) * length / slope)[:, None] * gradient
        distance = np.linalg.norm(points[under_way] - middles[under_way], axis=1)
        under_way = under_way[distance <= math.sqrt(3) * leaf_m]
    found: Doubles = points[arrived]
    return found[opened.has_surface(found)]


def print_diff(change: Change) -> None:
    """Print the figures of a difference, if there is any."""
    if not change.differs:
        print_line(f"  no difference at {change.points_a:,} surface points")
        return
    of_a, of_b = change.points_a, change.points_b
    columns = {
        "points A": f"{of_a:,}",
        "in B": f"{of_b:,}",
        "appeared %": _share(change.appeared, of_b),
        "newly seen %": _share(change.newly_seen, of_b),
        "vanished %": _share(change.vanished, of_a),
        "no longer known %": _share(change.no_longer_known, of_a),
        "moved %": _share(change.moved, of_a),
        "moved cm": _centimetres(change.moved_median_m),
        "95 % cm": _centimetres(change.moved_p95_m),
    }
    print_columns(list(columns), [list(columns.values())])
    if change.appeared > _OTHER_FRAME * of_b and change.vanished > _OTHER_FRAME * of_a:
        print_line(
            "  so much of each map is free space in the other: are both in one frame? They are "
            "compared as they are; a map by --odometry begins where its first scan was taken"
        )


def object_changes(comparison: Comparison) -> dict[str, list[Cluster]]:
    """Return what changed as a whole between two maps, by kind, that of most points first.

    What moved by more than a voxel vanished in one place and appeared in another.
    """
    return {kind: _clusters(found) for kind, found in comparison.changed.items()}


def print_objects(changes: Mapping[str, Sequence[Cluster]]) -> None:
    """Print a table of the largest of each kind, and how many there are besides."""
    rows = [
        (kind.replace("_", " "), f"{one.points:,}", *_metres(one.middle_m), *_metres(one.size_m))
        for kind, found in changes.items()
        for one in found[:_LISTED]
    ]
    if not rows:
        print_line("  nothing appeared, vanished or moved as a whole")
        return
    titles = ("what", "points", "middle x m", "y m", "z m", "size x m", "y m", "z m")
    print_columns(titles, rows)
    more = {kind.replace("_", " "): len(found) - _LISTED for kind, found in changes.items()}
    if smaller := ", ".join(f"{count} {kind}" for kind, count in more.items() if count > 0):
        print_line(f"  and smaller ones: {smaller}; --json prints all")


def _sighting(of: "OfflineMap", by: "OfflineMap") -> Sighting:
    points = surface_points(of)
    answer = by.query_sdf(points)
    return Sighting(points, answer.sdf, answer.status, leaf_m=of.leaf_m)


def _share(count: int, of: int) -> str:
    return f"{100 * count / of:.1f}" if count else "-"


def _centimetres(metres: float) -> str:
    return "-" if np.isnan(metres) else f"{100 * metres:.2f}"


def _clusters(sighting: Sighting) -> list[Cluster]:
    points = sighting.points
    groups = clusters(np.floor(points / sighting.leaf_m).astype(np.int64))
    _, numbers = np.unique(groups, return_inverse=True)
    order, sizes = np.argsort(numbers, kind="stable"), np.bincount(numbers)
    found = []
    for rows in np.split(order, np.cumsum(sizes))[:-1]:
        if len(rows) >= LEAST_POINTS:
            ends = points[rows].min(axis=0), points[rows].max(axis=0)
            low, high = (tuple(end.round(3).tolist()) for end in ends)
            found.append(Cluster(low, high, len(rows)))
    return sorted(found, key=lambda cluster: -cluster.points)


def _metres(place: Doubles) -> tuple[str, ...]:
    return tuple(f"{value:.2f}" for value in place)
