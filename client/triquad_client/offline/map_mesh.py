"""The surface of a map as triangles: marching cubes (Lorensen and Cline 1987), block by block.

Lattice points are the multiples of the cell, as those of the server's meshes, so that all blocks
agree on the points that they share. Only faces where rays have seen a surface are kept, and, where
that is asked for, those where it goes on into unknown space, which are marked: elsewhere the field
has zeros that nobody taught it.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.cells import cells_of_boxes, rows_by_cell
from triquad_format.records.region import MapRecord
from triquad_format.records.seen_space import surface_voxels
from triquad_map.filling import filled_voxels, on_filled
from triquad_map.seen_faces import are_seen
from triquad_map.view import MeshedView

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.mesh.mesh import Mesh
from triquad_client.mesh.tile_join import TileJoin

CELL_RANGE_M = (0.005, 10.0)
MAX_FACES = 50_000_000

BLOCK_CELLS = 64
"""Along each side of a block, as in the tiles of a server's mesh."""

REACH_LEAVES = 0.1  # how far beside a voxel with seen surface the middle of a face may lie
_CELL_LEAVES = 0.5

Report = Callable[[int, int], None]
"""Is told how many blocks are done, and of how many."""


BlockIndex = tuple[int, int, int]


@dataclass(frozen=True)
class _Voxels:
    """Voxels with surface, and the cells around each that may hold faces of it."""

    places: Longs  # [N, 3] on the lattice of voxels
    first: Longs  # [N, 3] least cell
    last: Longs  # [N, 3] greatest cell


class MeshBlocks:
    """The surface of a map, cut into cubes that are meshed one by one; for several threads.

    Each face is in one block. Blocks agree on the lattice points that they share, so there are no
    gaps between them.
    """

    def __init__(
        self,
        view: MeshedView,
        seen: MapRecord,
        cell_m: float,
        box: tuple[Doubles, Doubles],
        fill_m: float,
    ) -> None:
        """Use ``OfflineMap.mesh_blocks``; ``box`` are corners [3]."""
        self._view = view
        self._fill_m = fill_m
        self.cell_m = cell_m
        self.side_m = BLOCK_CELLS * cell_m
        """Of a block."""
        self._leaf_m = seen.settings.leaf_m
        self._reach_m = (0.5 + REACH_LEAVES) * self._leaf_m + cell_m / 2  # to a cell's middle
        middles = surface_voxels(seen)
        margin_m = 2 * self._reach_m
        if fill_m > 0:
            margin_m += fill_m + self._leaf_m  # filling begins beside the box, too
        low, high = box[0] - margin_m, box[1] + margin_m
        middles = middles[((middles >= low) & (middles <= high)).all(axis=1)]
        self._seen = len(middles)
        self._filled = filled_voxels(view, _places(middles, self._leaf_m), fill_m)
        self._middles = np.concatenate([middles, (self._filled.voxels + 0.5) * self._leaf_m])
        around = self._voxels(self._middles)
        blocks, rows = cells_of_boxes(around.first // BLOCK_CELLS, around.last // BLOCK_CELLS)
        self._rows = {
            (int(x), int(y), int(z)): rows[here] for (x, y, z), here in rows_by_cell(blocks)
        }

    @property
    def indices(self) -> Collection[BlockIndex]:
        """The blocks in which there may be faces: their least corners, in sides of a block."""
        return self._rows.keys()

    def mesh(self, index: BlockIndex) -> Mesh:
        """The faces in one of :attr:`indices`.

        Raises:
            InvalidInputError: scikit-image is not installed.
        """
        rows = self._rows[index]
        voxels = self._voxels(self._middles[rows])
        origin = np.array(index, np.int64) * BLOCK_CELLS
        cells = _covered(voxels.first - origin, voxels.last - origin)
        asked = np.argwhere(_any_of_eight(np.pad(cells, 1)))  # lattice points at their corners
        # Points that nobody asks for lie in free space.
        volume = np.ones((BLOCK_CELLS + 1,) * 3, np.float32)
        points = np.asarray((origin + asked) * self.cell_m, np.float64)
        volume[tuple(asked.T)] = self._view.query(points).sdf
        unknown = np.isnan(volume)  # beside the regions
        cells &= ~_any_of_eight(unknown)
        volume[unknown] = 1.0
        surface = _marched(volume, cells)
        vertices = (origin + surface.vertices) * self.cell_m
        middles = vertices[surface.faces].mean(axis=1)
        reach_m = REACH_LEAVES * self._leaf_m
        seen = are_seen(self._view, middles, self.cell_m, reach_m)
        if self._fill_m == 0:
            return Mesh(vertices, surface.faces[seen], self._view.epoch)
        filled = np.zeros(len(middles), np.bool_)
        filled[~seen] = on_filled(
            self._view,
            self._filled.chosen(rows[rows >= self._seen] - self._seen),
            middles[~seen],
            reach_m=reach_m,
            fill_m=self._fill_m,
        )
        kept = seen | filled
        return Mesh(vertices, surface.faces[kept], self._view.epoch, filled[kept])

    def _voxels(self, middles: Doubles) -> _Voxels:
        """The voxels with these middles [N, 3]."""
        return _Voxels(
            _places(middles, self._leaf_m),
            np.ceil((middles - self._reach_m) / self.cell_m - 0.5).astype(np.int64),
            np.floor((middles + self._reach_m) / self.cell_m - 0.5).astype(np.int64),
        )


def mesh_blocks(
    view: MeshedView,
    seen: MapRecord,
    cell_m: float | None,
    bounds: Bounds | None,
    fill_m: float = 0.0,
) -> MeshBlocks:
    """The blocks of a map; ``OfflineMap.mesh_blocks`` documents the rest.

    ``view`` answers for the field of the map, and ``seen`` holds its evidence; no more is read.
    """
    chosen_m = _CELL_LEAVES * view.voxel_m if cell_m is None else cell_m
    checked_m = checks.within("cell_m", chosen_m, CELL_RANGE_M[1], least=CELL_RANGE_M[0])
    return MeshBlocks(
        view, seen, checked_m, checks.box(bounds), fill_m=checks.length_to_fill(fill_m)
    )


def map_mesh(
    view: MeshedView,
    seen: MapRecord,
    bounds: Bounds | None,
    cell_m: float | None,
    report: Report | None,
    fill_m: float = 0.0,
) -> Mesh:
    """The surface of a map where rays have seen one, whole; arguments as of :func:`mesh_blocks`."""
    blocks = mesh_blocks(view, seen, cell_m, bounds, fill_m)
    join = TileJoin(blocks.side_m, checks.box(bounds), marked=fill_m > 0)
    faces = 0
    for number, index in enumerate(blocks.indices, start=1):
        part = blocks.mesh(index)
        join.add(part)
        faces += len(part.faces)
        if faces > MAX_FACES:
            raise InvalidInputError(
                f"the mesh has more than {MAX_FACES:,} faces with cells of {blocks.cell_m:g} m: "
                "ask for a smaller box, or larger cells"
            )
        if report is not None:
            report(number, len(blocks.indices))
    return join.mesh(view.epoch)


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
    low = np.clip(first, 0, BLOCK_CELLS)
    beyond = np.clip(last + 1, 0, BLOCK_CELLS)
    # How many boxes begin less how many end, summed up along each axis.
    changes = np.zeros((BLOCK_CELLS + 1,) * 3, np.int32)
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


def _places(middles: Doubles, leaf_m: float) -> Longs:
    """The voxels [N, 3] with these middles [N, 3], on the lattice of voxels."""
    return np.floor(middles / leaf_m).astype(np.int64)
