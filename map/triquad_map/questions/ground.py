"""The ground below points: what a robot would stand on, or that nothing is there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Longs
from triquad_format.records.status import Status

from triquad_map.questions.answer import Answer, drawn_on
from triquad_map.questions.distance import distances
from triquad_map.questions.rays import trace
from triquad_map.view import REACH_VOXELS, MapView

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STEEP = 0.5
"""The normal's z of a surface at 60 degrees. What is steeper is a wall: what is new there is not in
the way down. Down to as much overhang, the top edge of a wall bears: it leans as the field says."""

_DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, repr=False)
class Ground(Answer):
    """The ground below N points, of one epoch.

    ``SURFACE``: the first surface below the point, which is its ground. ``FREE``: none as far down
    as asked, and rays have passed through all of that: a hole or an edge. ``UNKNOWN``: some of
    what lies between has not been seen, or the point lies in or behind a surface.

    Attributes:
        points: [N, 3] metres, map frame: those that were asked about.
        status: [N] :class:`Status`, as above.
        height_m: [N] metres, map frame: z of the ground; else down to where all was seen to be
            free.
        normal: [N, 3] of the ground, a unit vector to free space, map frame; 0: there is none.
        confidence: [N] in [0, 1], as of distances; 0: there is none.
    """

    points: Doubles
    status: Bytes
    height_m: Doubles
    normal: Floats
    confidence: Floats
    epoch: int

    @property
    def slope_deg(self) -> Floats:
        """The slope of the ground [N], 0 to 90 degrees; 90 where there is none."""
        return np.degrees(np.arccos(np.clip(self.normal[:, 2], 0.0, 1.0)))

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the ground from above: its height in metres, crosses where rays saw that none is.

        What is unknown stays empty.

        Args:
            axes: where to draw; ``None``: axes of a new figure.

        Raises:
            InvalidInputError: matplotlib is not installed.
        """
        drawn = drawn_on(axes)
        found, none = (self[self.status == kind] for kind in (Status.SURFACE, Status.FREE))
        (x, y), (none_x, none_y) = found.points[:, :2].T, none.points[:, :2].T
        heights = drawn.scatter(x, y, s=9, c=found.height_m, cmap="viridis")
        drawn.figure.colorbar(heights, ax=drawn, label="height of the ground, m")
        drawn.scatter(none_x, none_y, s=9, c="tab:red", marker="x")
        drawn.set(title=f"ground, epoch {self.epoch}")
        return drawn


@dataclass(frozen=True)
class _Columns:
    """N ways straight down."""

    starts: Doubles  # [N, 3]
    depths: Doubles  # [N] to the first surface, or as far as asked
    hit: Bools  # [N] whether there is one
    buried: Bools  # [N] whether it begins in or behind one


def ground(view: MapView, points: Doubles, max_drop_m: float) -> Ground:
    """Return the ground at most ``max_drop_m`` below ``points`` [N, 3], metres, map frame."""
    columns = _columns(view, points, max_drop_m)
    unseen_m = np.where(columns.hit, REACH_VOXELS * view.voxel_m, 0.0)
    to_see_m = np.maximum(columns.depths - unseen_m, 0.0)
    seen_m = _seen_down(view, columns.starts, to_see_m)
    clear = (seen_m >= to_see_m) & ~columns.buried
    answer = Ground(
        points,
        status=np.where(clear & ~columns.hit, Status.FREE, Status.UNKNOWN).astype(np.uint8),
        height_m=np.minimum(columns.starts[:, 2] - seen_m, points[:, 2]),
        normal=np.zeros((len(points), 3), np.float32),
        confidence=np.zeros(len(points), np.float32),
        epoch=view.epoch,
    )
    rows = np.flatnonzero(clear & columns.hit)
    _stand(view, answer, rows, places=columns.starts[rows] + columns.depths[rows, None] * _DOWN)
    np.maximum(answer.height_m, points[:, 2] - max_drop_m, out=answer.height_m)
    return answer


def _stand(view: MapView, answer: Ground, rows: Longs, places: Doubles) -> None:
    """Put the ground into ``rows`` [R] of the answer, where ``places`` [R, 3] on it bear."""
    here = distances(view, places, view.voxel_m)
    up = here.gradient[:, 2]
    # Else it is met from behind, or unknown: no ray ended near.
    bears = (up > -_STEEP) & (here.confidence > 0) & _ended_near(view, places)
    answer.status[rows[bears]] = Status.SURFACE
    answer.height_m[rows[bears]] = places[bears, 2]
    answer.normal[rows[bears]] = here.gradient[bears]
    answer.confidence[rows[bears]] = here.confidence[bears]


def _columns(view: MapView, points: Doubles, max_drop_m: float) -> _Columns:
    """Return the columns below ``points`` [N, 3]; those at a surface begin a little above."""
    starts = points.copy()
    depths = np.full(len(points), max_drop_m)
    down = np.broadcast_to(_DOWN, starts.shape)
    hit = trace(view, starts, down, ranges=depths)
    buried = hit & (depths <= 0)
    low = np.flatnonzero(buried)
    lift_m = REACH_VOXELS * view.voxel_m
    starts[low, 2] += lift_m
    again = np.full(len(low), max_drop_m + lift_m)
    hit[low] = trace(view, starts[low], down[low], ranges=again)
    depths[low] = again
    buried[low] = hit[low] & (again <= 0)
    return _Columns(starts, depths, hit & ~buried, buried)


def _seen_down(view: MapView, starts: Doubles, depths: Doubles) -> Doubles:
    """Return how far below ``starts`` [N, 3] rays have shown all, at most ``depths`` [N].

    Between two seen places half a voxel apart there is nothing unknown: voxels are twice as high.
    What rays have seen only just now may have gaps in what is known of it: it is not seen through.
    """
    seen_m = np.zeros(len(starts))
    at = np.zeros(len(starts))
    going = np.flatnonzero(depths > 0)
    while len(going):
        places = starts[going] + at[going, None] * _DOWN
        status = view.status(places, reach_m=0.0)
        left_m = depths[going] - at[going]
        going = going[(status != Status.UNKNOWN) & ~_is_new(view, places, status, left_m)]
        seen_m[going] = at[going]
        going = going[at[going] < depths[going]]
        at[going] = np.minimum(at[going] + REACH_VOXELS * view.voxel_m, depths[going])
    return seen_m


def _is_new(view: MapView, places: Doubles, status: Bytes, left_m: Doubles) -> Bools:
    """Return whether rays ended in the voxels of ``places`` [N, 3] on what is new, not on a wall.

    ``left_m`` [N] is how far the first known surface below is, which needs a voxel itself.
    """
    new: Bools = (status == Status.SURFACE) & (left_m > view.voxel_m)
    rows = np.flatnonzero(new)
    nearest = view.nearest_surface(places[rows], view.voxel_m)
    is_wall = nearest.normal.any(axis=1) & (np.abs(nearest.normal[:, 2]) < _STEEP)
    new[rows] = nearest.found & ~nearest.learnt & ~is_wall
    return new


def _ended_near(view: MapView, points: Doubles) -> Bools:
    """Return whether rays ended in the voxels of ``points`` [N, 3], or closely above or below.

    Where none did, the field goes on from what lies next to it, as if a hole were covered.
    """
    near_m = REACH_VOXELS * view.voxel_m
    ended = np.zeros(len(points), np.bool_)
    for offset_m in (-near_m, 0.0, near_m):
        ended |= view.status(points + offset_m * _DOWN, reach_m=0.0) == Status.SURFACE
    return ended
