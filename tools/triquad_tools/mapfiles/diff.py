"""The places and sizes of differences of two maps; ``docs/tools.md`` defines every figure."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bytes, Doubles, Floats, Longs
from triquad_format.records.status import Status

from triquad_tools.console.lines import print_line
from triquad_tools.console.report import print_columns

if TYPE_CHECKING:  # slow to import
    from triquad_client import OfflineMap

NEAR_ENOUGH_M = 1e-4
"""A point this near to the zero of the field is on the surface."""

STILL_M = 1e-3
"""The least movement that counts: several times the error of a surface point."""

NOISE_M = 0.02
"""The greatest difference of two maps that learnt the same; it does not make a change great."""

_LISTED = 20  # tiles, at most
_STEPS = 8
_LEAST_SLOPE = 0.1  # a flatter field says nothing of where its zero is


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
    def in_one_map(self) -> dict[str, Sighting]:
        """The points that are surface in only one map, by what the other says of them."""
        return {
            "vanished": self.old.having(Status.FREE),
            "appeared": self.new.having(Status.FREE),
            "newly_seen": self.new.having(Status.UNKNOWN),
            "no_longer_known": self.old.having(Status.UNKNOWN),
        }


@dataclass(frozen=True)
class Change:
    """The difference of the surface in some volume between maps A and B; counts are of points."""

    points_a: int
    points_b: int
    appeared: int  # of B: A has seen free space there
    vanished: int  # of A: B has seen free space there
    newly_seen: int  # of B: A has seen nothing there
    no_longer_known: int  # of A: B has seen nothing there
    moved_median_m: float  # of the points of A that B has near its surface; NaN if there are none
    moved_p95_m: float
    changed_m3: float  # swept by moves beyond NOISE_M, and what appeared and vanished

    @property
    def differs(self) -> bool:
        """Whether there is any difference to report."""
        only_in_one = self.appeared or self.vanished or self.newly_seen or self.no_longer_known
        return bool(only_in_one) or self.moved_p95_m >= STILL_M


@dataclass(frozen=True)
class TileChange:
    """The difference of two maps in one tile."""

    low_m: tuple[float, ...]  # [3] corner, map frame
    high_m: tuple[float, ...]  # [3] opposite corner
    change: Change


@dataclass(frozen=True)
class MapDiff:
    """The difference of two maps."""

    tile_m: float
    total: Change
    tiles: tuple[TileChange, ...]  # those that differ, the greatest change first


def compare(a: "OfflineMap", b: "OfflineMap") -> Comparison:
    """Return the surface of each of two maps, asked in the other."""
    return Comparison(_sighting(a, b), _sighting(b, a))


def difference(comparison: Comparison, tile_m: float) -> MapDiff:
    """Return the figures of a comparison, in all and per cube of side ``tile_m``."""
    tiles = [tile for tile in _tiles(comparison, tile_m) if tile.change.differs]
    tiles.sort(
        key=lambda tile: (tile.change.changed_m3, np.nan_to_num(tile.change.moved_p95_m)),
        reverse=True,
    )
    return MapDiff(tile_m, _change(comparison), tuple(tiles))


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


def print_diff(diff: MapDiff) -> None:
    """Print the totals, and a table of the tiles that changed most."""
    if not diff.tiles:
        print_line(f"  no difference at {diff.total.points_a:,} surface points")
        return
    titles = ("from x m", "y m", "z m", "points A", "in B", "appeared %", "newly seen %",
              "vanished %", "no longer known %", "moved cm", "95 % cm")  # fmt: skip
    rows = [
        (*(f"{low:g}" for low in tile.low_m), *_cells(tile.change)) for tile in diff.tiles[:_LISTED]
    ]
    print_columns(titles, [*rows, ("all", "", "", *_cells(diff.total))])
    left = len(diff.tiles) - len(rows)
    if left > 0:
        print_line(f"  and {left} more: --json prints all")


def _sighting(of: "OfflineMap", by: "OfflineMap") -> Sighting:
    points = surface_points(of)
    answer = by.query_sdf(points)
    return Sighting(points, answer.sdf, answer.status, leaf_m=of.leaf_m)


def _tiles(comparison: Comparison, tile_m: float) -> Iterator[TileChange]:
    old, new = comparison.old, comparison.new
    count = len(old.points)
    cells = np.floor(np.concatenate([old.points, new.points]) / tile_m).astype(np.int64)
    for cell, rows in rows_by_cell(cells):
        inside = Comparison(old.part(rows[rows < count]), new.part(rows[rows >= count] - count))
        low, high = (tuple((end * tile_m).round(6).tolist()) for end in (cell, cell + 1))
        yield TileChange(low, high, _change(inside))


def _change(comparison: Comparison) -> Change:
    old, new = comparison.old, comparison.new
    counts = {kind: len(found.points) for kind, found in comparison.in_one_map.items()}
    moved = np.abs(old.having(Status.SURFACE).sdf).astype(np.float64)
    median, p95 = np.quantile(moved, [0.5, 0.95]) if len(moved) else (np.nan, np.nan)
    swept = float(moved[moved > NOISE_M].sum()) * old.leaf_m**2
    came_and_went = counts["vanished"] * old.leaf_m**3 + counts["appeared"] * new.leaf_m**3
    return Change(
        points_a=len(old.points),
        points_b=len(new.points),
        **counts,
        moved_median_m=float(median),
        moved_p95_m=float(p95),
        changed_m3=swept + came_and_went,
    )


def _cells(change: Change) -> tuple[str, ...]:
    return (
        f"{change.points_a:,}",
        f"{change.points_b:,}",
        _share(change.appeared, change.points_b),
        _share(change.newly_seen, change.points_b),
        _share(change.vanished, change.points_a),
        _share(change.no_longer_known, change.points_a),
        _centimetres(change.moved_median_m),
        _centimetres(change.moved_p95_m),
    )


def _share(count: int, of: int) -> str:
    return f"{100 * count / of:.1f}" if count else "-"


def _centimetres(metres: float) -> str:
    return "-" if np.isnan(metres) else f"{100 * metres:.2f}"


def rows_by_cell(cells: Longs) -> Iterator[tuple[Longs, NDArray[np.intp]]]:
    """Yield each different cell [3] of ``cells`` [N, 3], in order, with its ascending rows [K]."""
    different, numbers = np.unique(cells, axis=0, return_inverse=True)
    ends = np.cumsum(np.bincount(numbers.reshape(-1)))
    rows = np.split(np.argsort(numbers.reshape(-1), kind="stable"), ends)
    return zip(different, rows, strict=False)  # nothing is left behind the last end
