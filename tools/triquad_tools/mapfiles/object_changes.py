"""Objects that appeared, vanished or moved between two maps; ``docs/tools.md`` has the rules."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_map.clusters import clusters

from triquad_tools.console.command import print_line
from triquad_tools.console.report import print_columns
from triquad_tools.mapfiles.diff import Comparison, Sighting

LEAST_POINTS = 20
"""Clusters of fewer surface points are left out: noise makes them, too. These are 0.8 square metres
of surface in leaves of 0.2 m."""

_LISTED = 5  # clusters of a kind, at most: of two drives dozens of places moved by 2 cm


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
