"""Objects that appeared or vanished between two maps; ``docs/tools.md`` has the rules."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status
from triquad_map.clusters import clusters

from triquad_tools.console.lines import print_line
from triquad_tools.console.report import print_columns
from triquad_tools.mapfiles.diff import Comparison, Sighting, rows_by_cell

LEAST_POINTS = 20
"""Clusters of fewer surface points are left out: noise makes them, too. These are 0.8 square metres
of surface in leaves of 0.2 m."""

_LISTED = 20  # clusters, at most


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


@dataclass(frozen=True)
class ObjectChanges:
    """The objects in only one of two maps A and B, those of most points first.

    What moved vanished in one place and appeared in another.
    """

    vanished: tuple[Cluster, ...]  # only in A: B has seen free space there
    appeared: tuple[Cluster, ...]  # only in B: A has seen free space there
    newly_seen: tuple[Cluster, ...]  # only in B: A has seen nothing there
    no_longer_known: tuple[Cluster, ...]  # only in A: B has seen nothing there


def object_changes(comparison: Comparison) -> ObjectChanges:
    """Return what is in only one of two maps as a whole."""
    old, new = comparison.old, comparison.new
    return ObjectChanges(
        vanished=_clusters(old, Status.FREE),
        appeared=_clusters(new, Status.FREE),
        newly_seen=_clusters(new, Status.UNKNOWN),
        no_longer_known=_clusters(old, Status.UNKNOWN),
    )


def print_objects(changes: ObjectChanges) -> None:
    """Print a table of the first, and how many there are besides."""
    rows = [
        (kind.replace("_", " "), f"{one.points:,}", *_metres(one.middle_m), *_metres(one.size_m))
        for kind, found in vars(changes).items()
        for one in found
    ]
    if not rows:
        print_line("  nothing appeared or vanished as a whole")
        return
    titles = ("what", "points", "middle x m", "y m", "z m", "size x m", "y m", "z m")
    print_columns(titles, rows[:_LISTED])
    if len(rows) > _LISTED:
        print_line(f"  and {len(rows) - _LISTED} more: --json prints all")


def _clusters(sighting: Sighting, status: Status) -> tuple[Cluster, ...]:
    """Return clusters of points whose other status is ``status``, those of most points first."""
    points = sighting.having(status)
    voxels = np.floor(points / sighting.leaf_m).astype(np.int64)
    members = (points[rows] for _, rows in rows_by_cell(clusters(voxels)[:, None]))
    found = []
    for some in members:
        low, high = (tuple(end.round(3).tolist()) for end in (some.min(axis=0), some.max(axis=0)))
        if len(some) >= LEAST_POINTS:
            found.append(Cluster(low, high, len(some)))
    return tuple(sorted(found, key=lambda cluster: -cluster.points))


def _metres(place: Doubles) -> tuple[str, ...]:
    return tuple(f"{value:.2f}" for value in place)
