"""Fitting a cloud to what was seen before, by small_gicp.

What was seen is kept as Gaussians in cells (VGICP: Koide et al., ICRA 2021).
"""

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats

from triquad_tools.console.command import ToolError

_RANGES = 2.0  # times what 95 % of the points are within, up to which points are used
_NEAREST_M, _FARTHEST_M = 10.0, 100.0  # of these ranges
_CELLS, _POINTS = 50, 200
"""Cells of what was seen, and of the points of a scan that are used, to the largest range.

Streets with 16 to 128 beams and rooms drift by 0.3 % of the way at most; with cells half as large,
those with few beams by 8 %, with twice as many points by 10 %."""

_NEIGHBOURS = 20
"""Points of which the Gaussian of a point is made: with 10 they lie on one line of a lidar of 16
beams, which then drifted by 3 to 14 times as much, and by twice as much with 32."""

_FITS = 0.65
"""The share of a cloud's points that lie in cells seen before, below which it is somewhere else: it
was 0.75 at least where the way was right, and 0.6 at most in some scan where it was not."""

_HELD = 0.06
"""How well a cloud is held along one direction, as a share of another, below which it may slide, so
that it goes on there as before in part: 0.12 at least on streets and in rooms, 0.02 in a tunnel."""


def library() -> ModuleType:
    """Return small_gicp.

    Raises:
        ToolError: it is not installed.
    """
    try:
        import small_gicp
    except ModuleNotFoundError as error:
        raise ToolError("--odometry needs small_gicp: pip install 'triquad[tools]'") from error
    found: ModuleType = small_gicp
    return found


class Fit(NamedTuple):
    """Where a cloud fits what was seen, and how well."""

    pose: Doubles  # [4, 4] seen_from_cloud
    share: float  # of its points that lie in cells with points
    held: float  # along the direction that holds it least, as a share of the one that does most

    @property
    def is_there(self) -> bool:
        """Whether it was taken where that was seen."""
        return self.share >= _FITS

    @property
    def is_held(self) -> bool:
        """Whether it cannot slide along any direction."""
        return self.held >= _HELD


class Registration:
    """Fits the clouds of one lidar."""

    def __init__(self, reach_m: float) -> None:
        """``reach_m`` is within how many metres nearly all points are.

        Raises:
            ToolError: small_gicp is not installed.
        """
        self._library = library()
        self.range_m = float(np.clip(_RANGES * reach_m, _NEAREST_M, _FARTHEST_M))

    def thinned(self, points: NDArray[np.floating]) -> Floats:
        """Return one point [M, 3] for each small cell that points [N, 3] within range lie in."""
        near = points[np.linalg.norm(points, axis=1) < self.range_m]
        cloud = self._library.voxelgrid_sampling(near.astype(np.float64), self.range_m / _POINTS)
        return np.asarray(cloud.points()[:, :3], np.float32)

    def cloud(self, thinned: Floats) -> Any:
        """Return thinned points [M, 3] with the Gaussian of each."""
        cloud = self._library.PointCloud(thinned.astype(np.float64))
        self._library.estimate_covariances(cloud, num_neighbors=_NEIGHBOURS)
        return cloud

    def nothing_seen(self, scale: float = 1.0, *, forgets: bool = False) -> Any:
        """Return what :meth:`fit` fits to, before any cloud was inserted; its cells are scaled.

        One that forgets drops what 100 clouds in a row have not touched.
        """
        seen = self._library.GaussianVoxelMap(scale * self.range_m / _CELLS)
        if not forgets:
            seen.set_lru(2**31 - 1, 2**31 - 1)
        return seen

    def fit(self, seen: Any, cloud: Any, expected: Doubles, scale: float = 1.0) -> Fit:
        """Return where a cloud fits what was seen, near an expected pose [4, 4]."""
        reach = 2 * scale * self.range_m / _CELLS
        found = self._library.align(seen, cloud, expected, max_correspondence_distance=reach)
        share = found.num_inliers / max(cloud.size(), 1)
        held, directions = np.linalg.eigh(found.H[3:, 3:])
        held = held / max(held[2], 1e-300)
        pose: Doubles = found.T_target_source
        # What little holds goes on as expected (Zhang, Kaess and Singh, ICRA 2016), in part.
        loose = pose[:3, :3] @ directions * np.maximum(1 - held / _HELD, 0)
        pose[:3, 3] += loose @ directions.T @ pose[:3, :3].T @ (expected - pose)[:3, 3]
        return Fit(pose, share, float(held[0]))
