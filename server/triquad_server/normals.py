"""Surface normals from the scans so far: moments of the end points in two sparse grids.

A scan alone cannot tell the normal of far ground, where it is a few lines of points; the moments
of many scans can. The fine grid serves where it has a plane, the coarse one where it has not.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from triquad_server.threads import ANSWERS
from triquad_server.voxel_index import Index, VoxelIndex, find_row, make_row, pack

_MIN_POINTS = 6
_MAX_THICKNESS = 0.1  # of a plane: ratio of the least to the middle standard deviation
_MIN_WIDTH = 0.1  # ratio of the middle to the greatest: less is a line, not a plane

Moments = NDArray[np.float64]


@numba.njit(cache=True, nogil=True)
def _add(
    points: NDArray[np.float64],
    start: int,
    cell_m: float,
    index: Index,
    moments: Moments,
    count: int,
) -> tuple[int, int]:
    """Add points to the moments [cells, 10] of their cells, relative to the cells' centres."""
    for i in range(start, len(points)):
        x = int(np.floor(points[i, 0] / cell_m))
        y = int(np.floor(points[i, 1] / cell_m))
        z = int(np.floor(points[i, 2] / cell_m))
        row = make_row(index, count, pack(x, y, z))
        if row < 0:
            return i, count
        count = max(count, row + 1)
        m = moments[row]
        a = points[i, 0] - (x + 0.5) * cell_m
        b = points[i, 1] - (y + 0.5) * cell_m
        c = points[i, 2] - (z + 0.5) * cell_m
        m[0] += 1
        m[1] += a
        m[2] += b
        m[3] += c
        m[4] += a * a
        m[5] += a * b
        m[6] += a * c
        m[7] += b * b
        m[8] += b * c
        m[9] += c * c
    return len(points), count


@numba.njit(cache=True, nogil=True)
def _gather(
    point: NDArray[np.float64],
    cell_m: float,
    index: Index,
    moments: Moments,
    total: NDArray[np.float64],
) -> None:
    """Sum the moments of the 27 cells around a point, relative to its cell's centre."""
    total[:] = 0
    x = int(np.floor(point[0] / cell_m))
    y = int(np.floor(point[1] / cell_m))
    z = int(np.floor(point[2] / cell_m))
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                row = find_row(index, pack(x + i, y + j, z + k))
                if row < 0:
                    continue
                m = moments[row]
                a, b, c = i * cell_m, j * cell_m, k * cell_m
                n = m[0]
                total[0] += n
                total[1] += m[1] + n * a
                total[2] += m[2] + n * b
                total[3] += m[3] + n * c
                total[4] += m[4] + 2 * a * m[1] + n * a * a
                total[5] += m[5] + a * m[2] + b * m[1] + n * a * b
                total[6] += m[6] + a * m[3] + c * m[1] + n * a * c
                total[7] += m[7] + 2 * b * m[2] + n * b * b
                total[8] += m[8] + b * m[3] + c * m[2] + n * b * c
                total[9] += m[9] + 2 * c * m[3] + n * c * c


@numba.njit(cache=True, nogil=True)
def _plane_normal(m: NDArray[np.float64], normal: NDArray[np.float64]) -> bool:
    """Normal of the plane through points with the moments ``m``; False where there is none."""
    n = m[0]
    if n < _MIN_POINTS:
        return False
    mx, my, mz = m[1] / n, m[2] / n, m[3] / n
    xx, xy, xz = m[4] / n - mx * mx, m[5] / n - mx * my, m[6] / n - mx * mz
    yy, yz, zz = m[7] / n - my * my, m[8] / n - my * mz, m[9] / n - mz * mz
    # Eigenvalues of a symmetric 3 x 3 matrix (Smith 1961).
    mean = (xx + yy + zz) / 3
    off = xy * xy + xz * xz + yz * yz
    spread = np.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off) / 6)
    if spread <= 1e-12:
        return False
    a, b, c = (xx - mean) / spread, (yy - mean) / spread, (zz - mean) / spread
    d, e, f = xy / spread, xz / spread, yz / spread
    half_det = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2
    angle = np.arccos(min(1.0, max(-1.0, half_det))) / 3
    greatest = mean + 2 * spread * np.cos(angle)
    least = mean + 2 * spread * np.cos(angle + 2 * np.pi / 3)
    middle = 3 * mean - greatest - least
    if least > _MAX_THICKNESS**2 * middle or middle < _MIN_WIDTH**2 * greatest:
        return False
    # The eigenvector is orthogonal to the rows of (A - least I): take their longest cross product.
    rows = np.array([[xx - least, xy, xz], [xy, yy - least, yz], [xz, yz, zz - least]])
    longest = 0.0
    for i in range(3):
        cross = np.cross(rows[i], rows[(i + 1) % 3])
        length = (cross * cross).sum()
        if length > longest:
            longest = length
            normal[:] = cross
    if longest == 0.0:
        return False
    normal /= np.sqrt(longest)
    return True


@numba.njit(cache=True, nogil=True)
def _estimate(
    points: NDArray[np.float64],
    cell_m: float,
    index: Index,
    moments: Moments,
    normals: NDArray[np.float64],
) -> None:
    """Fill in the normals that are NaN and that this grid knows."""
    total = np.empty(10)
    normal = np.empty(3)
    for i in range(len(points)):
        if not np.isnan(normals[i, 0]):
            continue
        _gather(points[i], cell_m, index, moments, total)
        if _plane_normal(total, normal):
            normals[i] = normal


class MomentGrid:
    """Moments of points in the cells of a sparse lattice."""

    def __init__(self, cell_m: float) -> None:
        self._cell_m = cell_m
        self._cells = VoxelIndex(1024)
        self._moments = np.zeros((1024, 10))

    def add(self, points: NDArray[np.float64]) -> None:
        """Add points [N, 3], metres, map frame."""
        done = 0
        while done < len(points):
            index, count = self._cells.arrays, self._cells.count
            done, self._cells.count = _add(
                points,
                done,
                self._cell_m,
                index,
                self._moments,
                count,
            )
            if done < len(points):
                self._cells.grow()
                more = np.zeros((self._cells.capacity - len(self._moments), 10))
                self._moments = np.concatenate([self._moments, more])

    def estimate(self, points: NDArray[np.float64], normals: NDArray[np.float64]) -> None:
        """Fill those of ``normals`` [N, 3] that are NaN, where the points lie on a plane."""

        def work(first: int, last: int) -> None:
            part = slice(first, last)
            _estimate(points[part], self._cell_m, self._cells.arrays, self._moments, normals[part])

        ANSWERS.split(len(points), work)

    def keep_nearest(self, place: NDArray[np.float64], cells: int) -> None:
        """Keep the moments of the ``cells`` nearest to a ``place`` [3] only."""
        distance = np.linalg.norm(self._centres() - place, axis=1)
        self._keep(np.sort(np.argpartition(distance, cells)[:cells]))

    def forget(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Drop the moments of cells between the corners ``low`` and ``high`` [3]."""
        centres = self._centres()
        self._keep(np.flatnonzero(((centres < low) | (centres > high)).any(axis=1)))

    @property
    def cells(self) -> int:
        """Cells in use."""
        return self._cells.count

    def _centres(self) -> NDArray[np.float64]:
        return np.asarray((self._cells.cells() + 0.5) * self._cell_m, np.float64)

    def _keep(self, rows: NDArray[np.int64]) -> None:
        kept = self._moments[rows]
        self._cells = VoxelIndex.of_cells(self._cells.cells()[rows])
        self._moments = np.zeros((self._cells.capacity, 10))
        self._moments[: len(kept)] = kept


class SurfaceNormals:
    """Normals of the surfaces around the sensor; those farthest from it go first."""

    def __init__(
        self,
        fine_m: float = 0.15,
        coarse_m: float = 0.5,
        max_cells: int = 300_000,  # of each grid, at some 110 bytes
    ) -> None:
        self._grids = (MomentGrid(fine_m), MomentGrid(coarse_m))
        self._max_cells = max_cells

    def add(self, points: NDArray[np.float64], sensor: NDArray[np.float64]) -> None:
        """Add the end points [N, 3] of a scan from ``sensor`` [3], metres, map frame."""
        for grid in self._grids:
            grid.add(points)
            if grid.cells > self._max_cells:
                grid.keep_nearest(sensor, self._max_cells // 2)

    def forget(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Forget the surfaces between the corners ``low`` and ``high`` [3]."""
        for grid in self._grids:
            grid.forget(low, high)

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit normals [N, 3] of either sign; NaN where no plane is known."""
        normals = np.full(points.shape, np.nan)
        for grid in self._grids:
            grid.estimate(points, normals)
        return normals
