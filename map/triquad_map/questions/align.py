"""The pose of a scan: it is moved until its points lie on surfaces of the map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import orthonormal
from triquad_format.records.status import Status
from triquad_format.wire.limits import MAX_ITERATIONS

from triquad_map.questions.distance import distances
from triquad_map.view import REACH_VOXELS, MapView

_COARSE_POINTS = 500
"""The number of points that find the way; all that follows asks for a few millimetres."""

FINE_POINTS = 2000
"""About the number of points that are used in the end, however many are given."""

_SHRINK = 0.7
"""The scale becomes smaller by this factor with each step. With 0.5, scans that are off by 2 m and
10 degrees are sometimes drawn to the wrong wall."""

_SETTLED_M = 0.002
"""A step that moves the points by less is the last."""

_LEAST_INLIER_SHARE = 0.5
"""The least share of the points on surfaces, of those of which the map knows, for a pose to be
found."""

_OBSERVABLE = 0.01
"""A motion under which distances change by less (mean square, by that of the points) is not seen:
the map's normals are off by some degrees, which appear as much."""

_CORRELATED = 5.0
"""The number of points that count as one with an error of its own: neighbours share the map's. With
this the squared errors at real scans are 2 to 4 times what the covariance says, as the poses of
their maps have errors, too; at simulated ones a third."""

_UNSEEN_M, _UNSEEN_RAD = 100.0, math.pi
"""Standard deviations along what is not seen at all."""


@dataclass(frozen=True, repr=False)
class Alignment:
    """The pose where a scan fits best near a guess, in one epoch of the map.

    The covariance is that of an error ``(t, r)``: the true position is ``t`` away from the one
    found, metres, map frame, and the true rotation is the one found turned by the rotation vector
    ``r``, radians, map frame, about the sensor. Along what the surfaces do not fix (along a
    corridor) the guess is kept and the variance is that of 100 m or half a turn.

    Attributes:
        world_from_sensor: [4, 4] the pose, map frame.
        covariance: [6, 6] of translation, rotation, as above.
        inlier_share: of the points of which the map knows, those on a surface.
        rms_m: metres: of their distances; 0 where there are none.
        converged: it came to rest, most points are on surfaces, and these fix all directions.
        iterations: how many steps it took.
        points: how many were used, of those given.
    """

    world_from_sensor: Doubles
    covariance: Doubles
    inlier_share: float
    rms_m: float
    converged: bool
    iterations: int
    points: int
    epoch: int

    def __repr__(self) -> str:
        found = "converged" if self.converged else "not converged"
        fits = f"{self.inlier_share:.0%} on surfaces, rms {self.rms_m:.3g} m"
        return f"Alignment({found}, {self.points} points: {fits}; epoch {self.epoch})"


def align(view: MapView, points: Doubles, guess: Doubles, max_distance_m: float) -> Alignment:
    """Move a scan from where it is guessed to be to where it fits the map best.

    The squared distances of its points to the nearest seen surface are made small by Gauss-Newton
    steps on distance and gradient. Points count by a Geman-McClure kernel whose scale shrinks with
    each step from ``max_distance_m`` to half a voxel (graduated non-convexity). Until then, points
    in unknown space pull (a scan that is off by a metre lies behind walls), and far points count
    less: a wrong guess of the rotation moves them most. In the end points count by the map's
    confidence, and those in unknown space not at all.

    Args:
        view: the map.
        points: [N, 3] metres, sensor frame; those that are not finite are left out, and the
            rest is thinned to some 2000, evenly in space.
        guess: [4, 4] world_from_sensor.
        max_distance_m: points farther than this from any surface do not count.

    Raises:
        ValueError: ``points`` are not of this shape, or ``guess`` is no rigid pose.
    """
    pose = orthonormal(guess)
    fine = thinned(points, FINE_POINTS)
    found = _descend(view, fine, pose, max_distance_m)
    return _judged(view, fine, found, max_distance_m)


@dataclass(frozen=True)
class _Normal:
    """Normal equations of the motion ``(t, r * arm)`` that brings points to surfaces."""

    matrix: Doubles  # [6, 6] of mean square: the trace is that of one point
    vector: Doubles  # [6]
    arm_m: float  # RMS range of the points
    weight: float  # sum of all points' weights
    variance: float  # of the weighted distances

    def seen(self) -> tuple[Doubles, Doubles]:
        """Return directions [6, S] that the surfaces fix, as columns, and their information [S]."""
        values, vectors = np.linalg.eigh(self.matrix)
        seen = values > _OBSERVABLE
        return vectors[:, seen], values[seen]

    def step(self) -> Doubles:
        """Return the motion [6], none along what is not seen."""
        vectors, values = self.seen()
        step: Doubles = -vectors @ ((vectors.T @ self.vector) / values)
        return step

    @property
    def witnesses(self) -> float:
        """The number of points with an error of their own that would say as much."""
        return self.weight / _CORRELATED

    def covariance(self) -> Doubles:
        """Return the covariance of translation and rotation [6, 6]."""
        vectors, values = self.seen()
        scaling = np.repeat([1.0, self.arm_m], 3)
        information = (vectors * values) @ vectors.T * np.outer(scaling, scaling)
        information *= self.witnesses / max(self.variance, 1e-12)
        weak = np.repeat([1 / _UNSEEN_M**2, 1 / _UNSEEN_RAD**2], 3)
        covariance = np.linalg.inv(information + np.diag(weak))
        symmetric: Doubles = (covariance + covariance.T) / 2
        return symmetric


@dataclass(frozen=True)
class _Found:
    """The pose at which the search ended."""

    pose: Doubles  # [4, 4]
    iterations: int
    settled: bool


def _descend(view: MapView, fine: Doubles, pose: Doubles, max_distance_m: float) -> _Found:
    points = thinned(fine, _COARSE_POINTS)
    final = REACH_VOXELS * view.voxel_m
    scale = max(max_distance_m, final)
    for iteration in range(1, MAX_ITERATIONS + 1):
        normal = _normal(view, points, pose, scale, max_distance_m)
        if normal.weight == 0.0:
            return _Found(pose, iteration, False)
        step = normal.step()
        pose = moved(pose, step[:3], step[3:] / normal.arm_m)
        if scale == final and np.linalg.norm(step) < _SETTLED_M:
            return _Found(pose, iteration, True)
        scale = max(final, _SHRINK * scale)
        if scale == final:
            points = fine
    return _Found(pose, MAX_ITERATIONS, False)


def _normal(
    view: MapView, points: Doubles, pose: Doubles, scale: float, max_distance_m: float
) -> _Normal:
    """Return the normal equations at a pose; their weight is 0 where no point counts."""
    turned = points @ pose[:3, :3].T
    answer = distances(view, turned + pose[:3, 3], max_distance_m)
    distance = answer.distance_m.astype(np.float64)
    if scale == REACH_VOXELS * view.voxel_m:
        spread = np.ones(len(points))
        counts = answer.confidence.astype(np.float64)  # 0 in unknown space
    else:
        spread = 1.0 + np.linalg.norm(points, axis=1) / max_distance_m
        counts = answer.found / spread
    weights = counts / (1.0 + (distance / (scale * spread)) ** 2) ** 2
    weight = float(weights.sum())
    share = weights / max(weight, 1e-12)
    arm_m = max(math.sqrt(float(share @ (turned**2).sum(axis=1))), 1e-6)
    slope = answer.gradient.astype(np.float64)
    rows = np.hstack([slope, np.cross(turned, slope) / arm_m])
    weighted = share[:, None] * rows
    return _Normal(
        matrix=weighted.T @ rows,
        vector=weighted.T @ distance,
        arm_m=arm_m,
        weight=weight,
        variance=float(share @ distance**2),
    )


def _judged(view: MapView, points: Doubles, found: _Found, max_distance_m: float) -> Alignment:
    """Return the alignment at the pose where the search ended."""
    world = points @ found.pose[:3, :3].T + found.pose[:3, 3]
    answer = distances(view, world, max_distance_m)
    inliers = answer.found & (answer.status == Status.SURFACE)
    count = int(inliers.sum())
    share = count / max(int((answer.found | (answer.status != Status.UNKNOWN)).sum()), 1)
    squares = answer.distance_m[inliers].astype(np.float64) ** 2
    rms_m = math.sqrt(float(squares.sum()) / max(count, 1))
    normal = _normal(view, points, found.pose, REACH_VOXELS * view.voxel_m, max_distance_m)
    holds = len(normal.seen()[1]) == 6 and normal.witnesses > 6
    return Alignment(
        world_from_sensor=found.pose,
        covariance=normal.covariance(),
        inlier_share=share,
        rms_m=rms_m,
        converged=found.settled and holds and share >= _LEAST_INLIER_SHARE,
        iterations=found.iterations,
        points=len(points),
        epoch=view.epoch,
    )


_CELLS = 1 << 20  # along an axis
_MARGIN = 1.1
"""Points up to this multiple of those wanted are as good: to thin once more changes nothing."""


def thinned(points: Doubles, most: int) -> Doubles:
    """Return about ``most`` of points [N, 3], evenly in space: the first of each cell of a grid.

    Points that are not finite are left out. What was thinned before stays as it is. With numpy
    alone: clients thin scans with it before they send them, and they may be without numba.

    Raises:
        ValueError: ``points`` are not of this shape.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have the shape {points.shape}: give [N, 3]")
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) <= _MARGIN * most:
        return points
    offsets = points - np.median(points, axis=0)
    # From cells of which the surfaces in sight fill more, to those of which they do not.
    side_m = max(float(np.median(np.abs(offsets))), 1e-3) / 256
    while True:
        cells = np.clip(np.floor(offsets / side_m) + _CELLS / 2, 0, _CELLS - 1).astype(np.int64)
        keys = (cells[:, 0] * _CELLS + cells[:, 1]) * _CELLS + cells[:, 2]
        first = np.sort(np.unique(keys, return_index=True)[1])
        points, offsets = points[first], offsets[first]
        if len(points) <= _MARGIN * most:
            return points
        side_m *= max(1.1, math.sqrt(len(points) / most))


def moved(pose: Doubles, translation: Doubles, rotation: Doubles) -> Doubles:
    """Return a pose moved [3], and turned about itself by a rotation vector [3], map frame."""
    result: Doubles = pose.copy()
    result[:3, :3] = _rotation(rotation) @ pose[:3, :3]
    result[:3, 3] += translation
    return result


def _rotation(vector: Doubles) -> Doubles:
    """Return the rotation [3, 3] about a vector [3] by its length (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    first = float(np.sinc(angle / math.pi))
    second = 0.5 * float(np.sinc(angle / (2 * math.pi))) ** 2
    rotation: Doubles = np.eye(3) + first * cross + second * (cross @ cross)
    return rotation
