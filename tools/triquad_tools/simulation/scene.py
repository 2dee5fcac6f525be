"""An exact world: a union of convex solids that answers signed distances and rays without error."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from triquad_format.records.arrays import Bools, Doubles
from triquad_map.compiled.kernel import inner_kernel, kernel

from triquad_tools.simulation.solids import BOUND, Solid, X, Y, Z, distance_to, solid_table

_ON_SURFACE_M = 1e-7
_NEWTON_STEPS = 64
_HIT_M = 1e-8  # a ray this close to a surface has hit it


@dataclass(frozen=True)
class Scene:
    """A union of solids in a world frame, right-handed, z up, metres.

    The signed distance is positive in free space and negative inside solids. Outside it is exact
    everywhere. Inside it is exact wherever :meth:`is_exact` says so: everywhere but near seams,
    where the nearest surface of one solid lies hidden inside another one. There its magnitude is
    a lower bound of the depth.
    """

    solids: tuple[Solid, ...]
    bounds: Doubles  # [2, 3] lower and upper corner of the part of interest, metres
    drive_length_m: float = 0.0  # of the road along x, from the origin
    houses: tuple[Solid, ...] = ()  # those of the solids that are part of a house

    @property
    def box(self) -> tuple[list[float], list[float]]:
        """The bounds as two corners, as the client's questions take them."""
        low, high = self.bounds.tolist()
        return low, high

    def sdf(self, points: Doubles) -> Doubles:
        """Return signed distances ``[N]`` in metres at points ``[N, 3]`` of the world."""
        return _nearest(self._table, _rows(points))[0]

    def gradient(self, points: Doubles) -> Doubles:
        """Return unit gradients ``[N, 3]`` of the signed distance at world points ``[N, 3]``."""
        return _nearest(self._table, _rows(points))[1]

    def is_exact(self, points: Doubles) -> Bools:
        """Return whether the signed distance is exact, ``[N]``, at points ``[N, 3]`` of the world.

        No part of the surface is nearer than the distance says; it is exact where the closest
        point that it gives really lies on the surface.
        """
        distances, gradients = _nearest(self._table, _rows(points))
        closest = points - distances[:, None] * gradients
        return (distances >= 0.0) | (np.abs(self.sdf(closest)) < _ON_SURFACE_M)

    def is_inside_house(self, points: Doubles, margin_m: float = 0.5) -> Bools:
        """Return whether points ``[N, 3]`` lie over ``margin_m`` deep in a house: never seen."""
        return Scene(self.houses, self.bounds).sdf(points) < -margin_m

    def cast(self, origin: Doubles, directions: Doubles, range_max_m: float) -> Doubles:
        """Return ranges ``[N]``, metres, at which rays first hit a solid; infinite if none.

        Args:
            origin: ``[3]`` metres, world frame, in free space.
            directions: ``[N, 3]`` unit vectors, world frame.
            range_max_m: rays end here.
        """
        start = np.ascontiguousarray(origin, np.float64)
        offsets = self._table[:, [X, Y, Z]] - start
        gaps = np.linalg.norm(offsets, axis=1) - self._table[:, BOUND]
        order = np.argsort(gaps, kind="stable")  # nearest first: the first hits rule out the rest
        order = order[gaps[order] < range_max_m]
        ordered = np.ascontiguousarray(self._table[order])
        rays = _rows(directions)
        return _cast(ordered, offsets[order], gaps[order], start, rays, range_max_m)

    @cached_property
    def _table(self) -> Doubles:
        return solid_table(self.solids)


def _rows(points: Doubles) -> Doubles:
    """Return ``points`` as the contiguous ``[N, 3]`` float64 that the kernels are compiled for."""
    rows = np.ascontiguousarray(points, np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"expected points [N, 3], got an array {list(rows.shape)}")
    return rows


@kernel()
def _nearest(solids: Doubles, points: Doubles) -> tuple[Doubles, Doubles]:
    count = points.shape[0]
    distances = np.full(count, np.inf)
    gradients = np.zeros((count, 3))
    for i in range(count):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for s in range(solids.shape[0]):
            dx, dy, dz = x - solids[s, X], y - solids[s, Y], z - solids[s, Z]
            # No part of a solid is nearer than the sphere around it.
            if math.sqrt(dx * dx + dy * dy + dz * dz) - solids[s, BOUND] > distances[i]:
                continue
            distance, gx, gy, gz = distance_to(solids[s], x, y, z)
            if distance < distances[i]:
                distances[i] = distance
                gradients[i, 0], gradients[i, 1], gradients[i, 2] = gx, gy, gz
    return distances, gradients


@kernel()
def _cast(
    solids: Doubles,
    offsets: Doubles,
    gaps: Doubles,
    origin: Doubles,
    directions: Doubles,
    range_max_m: float,
) -> Doubles:
    # Every solid is convex, so its signed distance is a convex function along any ray: Newton's
    # method started outside never steps past the first hit.
    outside = np.empty(solids.shape[0])  # squared distance to the centre less squared radius
    for s in range(solids.shape[0]):
        centre = offsets[s]
        outside[s] = np.sum(centre * centre) - solids[s, BOUND] ** 2
    ranges = np.empty(directions.shape[0])
    for i in range(directions.shape[0]):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        best = range_max_m
        for s in range(solids.shape[0]):
            if gaps[s] >= best:
                break
            start = 0.0
            if outside[s] > 0.0:
                middle = offsets[s, 0] * dx + offsets[s, 1] * dy + offsets[s, 2] * dz
                half2 = middle * middle - outside[s]
                if middle <= 0.0 or half2 < 0.0:
                    continue
                start = middle - math.sqrt(half2)
            if start < best:
                best = _hit(solids[s], origin, directions[i], start, best)
        ranges[i] = best if best < range_max_m else np.inf
    return ranges


@inner_kernel()
def _hit(row: Doubles, origin: Doubles, direction: Doubles, start: float, limit: float) -> float:
    """Return the range from ``start`` on at which a ray hits one solid; ``limit`` if nearer."""
    dx, dy, dz = direction[0], direction[1], direction[2]
    t = start
    for _ in range(_NEWTON_STEPS):
        if t >= limit:
            return limit
        x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
        distance, gx, gy, gz = distance_to(row, x, y, z)
        if distance < _HIT_M:
            return t
        slope = gx * dx + gy * dy + gz * dz
        if slope >= 0.0:  # convex along the ray: from here on it only moves away
            return limit
        t -= distance / slope
    return t
