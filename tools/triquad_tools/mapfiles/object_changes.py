"""Objects that appeared, vanished or moved between two maps; ``docs/tools.md`` has the rules."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.cells import rows_by_cell
from triquad_format.records.status import Status
from triquad_map.clusters import clusters

from triquad_tools.console.lines import print_line
from triquad_tools.console.report import print_columns
from triquad_tools.mapfiles.diff import Comparison, Sighting

LEAST_POINTS = 20
"""Clusters of fewer surface points are counted, but not listed: noise makes them, too. These
are 0.8 square metres of surface in leaves of 0.2 m."""

FARTHEST_M = 5.0
"""Anything that lies farther from where something vanished is something else."""

LEAST_SIZE_SHARE, LEAST_POINTS_SHARE = 0.7, 0.5
"""If two are the same, the smaller size along each axis is such a share of the larger, and so is
the smaller number of points, which depends on where it was seen from."""

Corner = tuple[float, ...]


@dataclass(frozen=True)
class Cluster:
    """Surface points that lie together, and the box around them."""

    low_m: Corner  # [3] map frame
    high_m: Corner  # [3]
    points: int

    @property
    def middle_m(self) -> Doubles:
        """[3] of the box."""
        return np.add(self.low_m, self.high_m) / 2

    @property
    def size_m(self) -> Doubles:
        """[3] of the box, along the axes."""
        return np.subtract(self.high_m, self.low_m)


@dataclass(frozen=True)
class Move:
    """A cluster that vanished, and one like it that appeared near it."""

    before: Cluster
    after: Cluster
    distance_m: float  # between the middles of their boxes


@dataclass(frozen=True)
class SmallClusters:
    """The number of clusters that have too few points to be listed."""

    vanished: int
    appeared: int
    newly_seen: int
    no_longer_known: int


@dataclass(frozen=True)
class ObjectChanges:
    """The objects in only one of two maps A and B, those of most points first."""

    moved: tuple[Move, ...]
    vanished: tuple[Cluster, ...]  # only in A: B has seen free space there
    appeared: tuple[Cluster, ...]  # only in B: A has seen free space there
    newly_seen: tuple[Cluster, ...]  # only in B: A has seen nothing there
    no_longer_known: tuple[Cluster, ...]  # only in A: B has seen nothing there
    small: SmallClusters


def object_changes(comparison: Comparison) -> ObjectChanges:
    """Return what appeared, vanished and moved from one map to the other."""
    old, new = comparison.old, comparison.new
    vanished, appeared = _clusters(old, Status.FREE), _clusters(new, Status.FREE)
    newly_seen, unknown = _clusters(new, Status.UNKNOWN), _clusters(old, Status.UNKNOWN)
    moved = moves(_large(vanished), _large(appeared), max(old.leaf_m, new.leaf_m))
    return ObjectChanges(
        moved=moved,
        vanished=_without(_large(vanished), [move.before for move in moved]),
        appeared=_without(_large(appeared), [move.after for move in moved]),
        newly_seen=_large(newly_seen),
        no_longer_known=_large(unknown),
        small=SmallClusters(
            vanished=_count_small(vanished),
            appeared=_count_small(appeared),
            newly_seen=_count_small(newly_seen),
            no_longer_known=_count_small(unknown),
        ),
    )


def moves(
    vanished: tuple[Cluster, ...], appeared: tuple[Cluster, ...], leaf_m: float
) -> tuple[Move, ...]:
    """Return moves, those of most points first; the nearest pairs are matched first."""
    alike = [pair for pair in _near_pairs(vanished, appeared) if _alike(pair, leaf_m)]
    chosen: list[Move] = []
    for pair in sorted(alike, key=lambda pair: pair.distance_m):
        if all(pair.before is not one.before and pair.after is not one.after for one in chosen):
            chosen.append(pair)
    return tuple(sorted(chosen, key=lambda move: -move.after.points))


def print_objects(changes: ObjectChanges, limit: int) -> None:
    """Print a table of the ``limit`` first, and how many there are besides."""
    rows = list(_rows(changes))
    if rows:
        titles = ("what", "points", "middle x m", "y m", "z m", "size x m", "y m", "z m",
                  "moved m", "by x m", "y m", "z m")  # fmt: skip
        print_columns(titles, rows[:limit])
    else:
        print_line("  nothing appeared, vanished or moved as a whole")
    if len(rows) > limit:
        print_line(f"  and {len(rows) - limit} more: --limit {len(rows)} shows all")
    small = changes.small
    print_line(
        f"  and clusters of fewer than {LEAST_POINTS} points: {small.vanished} vanished, "
        f"{small.appeared} appeared, {small.newly_seen} newly seen, "
        f"{small.no_longer_known} no longer known"
    )


def _clusters(sighting: Sighting, status: Status) -> list[Cluster]:
    """Return clusters of points whose other status is ``status``, those of most points first."""
    points = sighting.having(status)
    voxels = np.floor(points / sighting.leaf_m).astype(np.int64)
    members = (points[rows] for _, rows in rows_by_cell(clusters(voxels)[:, None]))
    found = [_cluster(points) for points in members]
    return sorted(found, key=lambda cluster: -cluster.points)


def _cluster(points: Doubles) -> Cluster:
    low, high = (tuple(end.round(3).tolist()) for end in (points.min(axis=0), points.max(axis=0)))
    return Cluster(low, high, len(points))


def _large(found: list[Cluster]) -> tuple[Cluster, ...]:
    return tuple(cluster for cluster in found if cluster.points >= LEAST_POINTS)


def _count_small(found: list[Cluster]) -> int:
    return sum(cluster.points < LEAST_POINTS for cluster in found)


def _without(found: tuple[Cluster, ...], moved: list[Cluster]) -> tuple[Cluster, ...]:
    taken = set(map(id, moved))  # two may be equal
    return tuple(cluster for cluster in found if id(cluster) not in taken)


def _near_pairs(vanished: tuple[Cluster, ...], appeared: tuple[Cluster, ...]) -> Iterator[Move]:
    places = np.array([cluster.middle_m for cluster in appeared]).reshape(-1, 3)
    for before in vanished:
        distances_m = np.linalg.norm(places - before.middle_m, axis=1)
        for row in np.flatnonzero(distances_m <= FARTHEST_M):
            yield Move(before, appeared[row], float(distances_m[row]))


def _alike(pair: Move, leaf_m: float) -> bool:
    """Return whether both may be the same: by points, and by size, which is off by a leaf."""
    fewer, more = sorted([pair.before.points, pair.after.points])
    smaller = np.minimum(pair.before.size_m, pair.after.size_m)
    larger = np.maximum(pair.before.size_m, pair.after.size_m)
    same_size = np.maximum(smaller / LEAST_SIZE_SHARE, smaller + leaf_m) >= larger
    return fewer >= LEAST_POINTS_SHARE * more and bool(same_size.all())


def _rows(changes: ObjectChanges) -> Iterator[tuple[str, ...]]:
    for move in changes.moved:
        way = move.after.middle_m - move.before.middle_m
        yield (*_cells("moved", move.after), f"{move.distance_m:.2f}", *_metres(way))
    kinds = {
        "vanished": changes.vanished,
        "appeared": changes.appeared,
        "newly seen": changes.newly_seen,
        "no longer known": changes.no_longer_known,
    }
    for kind, found in kinds.items():
        for cluster in found:
            yield (*_cells(kind, cluster), "", "", "", "")


def _cells(kind: str, cluster: Cluster) -> tuple[str, ...]:
    return (kind, f"{cluster.points:,}", *_metres(cluster.middle_m), *_metres(cluster.size_m))


def _metres(place: Doubles) -> tuple[str, ...]:
    return tuple(f"{value:.2f}" for value in place)
