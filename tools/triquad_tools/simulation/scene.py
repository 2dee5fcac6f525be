"""An exact world: a union of convex solids that answers signed distances without error."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from triquad_tools.simulation.nearest import CandidateGrid, Nearest, candidate_grid, nearest
from triquad_tools.simulation.rays import cast_rays
from triquad_tools.simulation.solids import Label, Solid, solid_table

_ON_SURFACE_M = 1e-7


@dataclass(frozen=True)
class Scene:
    """A union of solids in a world frame, right-handed, z up, metres.

    The signed distance is positive in free space and negative inside solids. Outside it is exact
    everywhere. Inside it is exact wherever :meth:`is_exact` says so: everywhere but beside seams,
    where the nearest surface of one solid lies hidden inside another one. There its magnitude is
    a lower bound of the depth.
    """

    solids: tuple[Solid, ...]
    bounds: NDArray[np.float64]  # [2, 3] lower and upper corner of the part of interest, metres
    drive_length_m: float = 0.0  # of the road along x, from the origin

    def sdf(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distances ``[N]`` in metres at points ``[N, 3]`` of the world."""
        return self._nearest(points).distances

    def gradient(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit gradients ``[N, 3]`` of the signed distance at points ``[N, 3]`` of the world."""
        return self._nearest(points).gradients

    def is_exact(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the signed distance is exact, ``[N]``, at points ``[N, 3]`` of the world.

        No part of the surface is nearer than the distance says; it is exact where the closest
        point that it tells of really lies on the surface.
        """
        found = self._nearest(points)
        closest = points - found.distances[:, None] * found.gradients
        return (found.distances >= 0.0) | (np.abs(self.sdf(closest)) < _ON_SURFACE_M)

    def is_inside_house(
        self, points: NDArray[np.float64], margin_m: float = 0.5
    ) -> NDArray[np.bool_]:
        """Whether points ``[N, 3]`` lie deeper than ``margin_m`` in a house: space never seen."""
        return self._houses.sdf(points) < -margin_m

    def cast(
        self,
        origin: NDArray[np.float64],
        directions: NDArray[np.float64],
        range_max_m: float,
    ) -> NDArray[np.float64]:
        """Ranges ``[N]`` in metres at which rays first hit a solid; infinite where none does.

        Args:
            origin: ``[3]`` metres, world frame, in free space.
            directions: ``[N, 3]`` unit vectors, world frame.
            range_max_m: rays end here.
        """
        start = np.ascontiguousarray(origin, np.float64)
        return cast_rays(self._table, start, _rows(directions), range_max_m)

    @cached_property
    def _table(self) -> NDArray[np.float64]:
        return solid_table(self.solids)

    @cached_property
    def _grid(self) -> CandidateGrid:
        return candidate_grid(self._table, self.bounds)

    @cached_property
    def _houses(self) -> "Scene":
        houses = tuple(solid for solid in self.solids if solid.label == Label.HOUSE)
        return Scene(houses, self.bounds)

    def _nearest(self, points: NDArray[np.float64]) -> Nearest:
        return nearest(self._table, self._grid, _rows(points))


def _rows(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """``points`` as the contiguous ``[N, 3]`` float64 that the kernels are compiled for."""
    rows = np.ascontiguousarray(points, np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"expected points [N, 3], got an array {list(rows.shape)}")
    return rows
