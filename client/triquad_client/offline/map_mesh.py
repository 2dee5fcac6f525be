"""The surface of a map as triangles: marching cubes (Lorensen and Cline 1987), block by block.

Lattice points are the multiples of the cell, as those of the server's meshes, so that all blocks
agree on the points that they share. Only faces where rays have seen a surface are kept: elsewhere
the field has zeros that nobody taught it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.cells import cells_of_boxes, rows_by_cell
from triquad_format.records.region import MapRecord
from triquad_format.records.seen_space import surface_voxels
from triquad_map.view import MapView

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.mesh.mesh import Mesh, joined

CELL_RANGE_M = (0.01, 10.0)
MAX_FACES = 50_000_000

_BLOCK_CELLS = 32  # along the side of a block: bounds the memory that is needed at once
_REACH_M = 0.02  # how far beside a voxel with seen surface the middle of a face may lie

Report = Callable[[int, int], None]
"""Is told how many blocks are done, and of how many."""


@dataclass(frozen=True)
class _Voxels:
    """Voxels with seen surface, and the cells around each that may hold faces of it."""

    places: Longs  # [N, 3] on the lattice of voxels
    first: Longs  # [N, 3] least cell
    last: Longs  # [N, 3] greatest cell

    def __getitem__(self, rows: NDArray[np.intp]) -> "_Voxels":
        return _Voxels(self.places[rows], self.first[rows], self.last[rows])


def map_mesh(
    view: MapView, seen: MapRecord, bounds: Bounds | None, cell_m: float, report: Report | None
) -> Mesh:
    """The surface of a map where rays have seen one; ``OfflineMap.mesh`` documents the rest.

    ``view`` answers for the field of the map, and ``seen`` holds its evidence; no more is read.
    """
    cell_m = checks.within("cell_m", cell_m, CELL_RANGE_M[1], least=CELL_RANGE_M[0])
    box = checks.box(bounds)
    blocks = list(_blocks(_voxels(seen, *box, cell_m=cell_m)))
    tiles: list[Mesh] = []
    faces = 0
    for number, (block, voxels) in enumerate(blocks, start=1):
        tiles.append(_block_mesh(view, block, voxels, cell_m=cell_m))
        faces += len(tiles[-1].faces)
        if faces > MAX_FACES:
            raise InvalidInputError(
                f"the mesh has more than {MAX_FACES:,} faces with cells of {cell_m:g} m: "
                "ask for a smaller box, or larger cells"
            )
        if report is not None:
            report(number, len(blocks))
    return joined(tiles, _BLOCK_CELLS * cell_m, box=box, epoch=view.epoch)


def _voxels(seen: MapRecord, low: Doubles, high: Doubles, cell_m: float) -> _Voxels:
    """The voxels of which faces may lie between two corners [3]."""
    leaf_m = seen.settings.leaf_m
    middles = surface_voxels(seen)
    reach_m = leaf_m / 2 + _REACH_M + cell_m / 2  # from a voxel's middle to that of a cell
    near = (middles >= low - 2 * reach_m) & (middles <= high + 2 * reach_m)
    middles = middles[near.all(axis=1)]
    return _Voxels(
        np.floor(middles / leaf_m).astype(np.int64),
        np.ceil((middles - reach_m) / cell_m - 0.5).astype(np.int64),
        np.floor((middles + reach_m) / cell_m - 0.5).astype(np.int64),
    )


def _blocks(voxels: _Voxels) -> Iterator[tuple[Longs, _Voxels]]:
    """The blocks of cells [3] that voxels reach into, each with these voxels."""
    first, last = voxels.first // _BLOCK_CELLS, voxels.last // _BLOCK_CELLS
    blocks, rows = cells_of_boxes(first, last)
    return ((block, voxels[rows[here]]) for block, here in rows_by_cell(blocks))


def _block_mesh(view: MapView, block: Longs, voxels: _Voxels, cell_m: float) -> Mesh:
    origin = block * _BLOCK_CELLS
    cells = _covered(voxels.first - origin, voxels.last - origin)
    asked = np.argwhere(_any_of_eight(np.pad(cells, 1)))  # lattice points at their corners
    # Points that nobody asks for lie in free space.
    volume = np.ones((_BLOCK_CELLS + 1,) * 3, np.float32)
    volume[tuple(asked.T)] = view.query(np.asarray((origin + asked) * cell_m, np.float64)).sdf
    unknown = np.isnan(volume)  # beside the regions
    cells &= ~_any_of_eight(unknown)
    volume[unknown] = 1.0
    surface = _marched(volume, cells)
    vertices = (origin + surface.vertices) * cell_m
    seen = _beside(voxels.places, vertices[surface.faces].mean(axis=1), view.voxel_m)
    return Mesh(vertices, surface.faces[seen])


def _marched(volume: Floats, cells: Bools) -> Mesh:
    """Triangles between lattice points, in units of cells, counter-clockwise from free space."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise InvalidInputError("scikit-image is missing: pip install 'triquad[mesh]'") from error
    mask = np.zeros(volume.shape, np.bool_)
    mask[1:, 1:, 1:] = cells  # a cell is named by its upper corner there
    try:
        vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=mask, method="lorensen")
    except (ValueError, RuntimeError):  # so it tells that no cell is crossed
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    return Mesh(vertices.astype(np.float64), faces)


def _covered(first: Longs, last: Longs) -> Bools:
    """The cells of a block that lie in any of the boxes ``first`` to ``last`` [N, 3]."""
    low = np.clip(first, 0, _BLOCK_CELLS)
    beyond = np.clip(last + 1, 0, _BLOCK_CELLS)
    # How many boxes begin less how many end, summed up along each axis.
    changes = np.zeros((_BLOCK_CELLS + 1,) * 3, np.int32)
    for corner in np.ndindex(2, 2, 2):
        at = np.where(corner, beyond, low)
        np.add.at(changes, tuple(at.T), (-1) ** sum(corner))
    boxes = changes.cumsum(axis=0).cumsum(axis=1).cumsum(axis=2)
    return np.asarray(boxes[:-1, :-1, :-1] > 0)


def _any_of_eight(flags: Bools) -> Bools:
    """Whether any of 2 x 2 x 2 neighbours is set; one less along each side than ``flags``."""
    flags = flags[:-1] | flags[1:]
    flags = flags[:, :-1] | flags[:, 1:]
    return flags[:, :, :-1] | flags[:, :, 1:]


def _beside(voxels: Longs, points: Doubles, leaf_m: float) -> Bools:
    """Whether points [P, 3] lie within the reach of any of the voxels [N, 3], on each axis."""
    sides = [
        np.floor((points + shift) / leaf_m).astype(np.int64) for shift in (-_REACH_M, _REACH_M)
    ]
    least = voxels.min(axis=0) - 1
    near = np.zeros(len(points), np.bool_)
    for x, y, z in np.ndindex(2, 2, 2):
        corner = np.stack([sides[x][:, 0], sides[y][:, 1], sides[z][:, 2]], axis=1)
        near |= np.isin(_key(corner - least), _key(voxels - least))
    return near


def _key(cells: Longs) -> Longs:
    """One number for each of cells [N, 3] that lie near to each other."""
    return np.asarray((cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2])
