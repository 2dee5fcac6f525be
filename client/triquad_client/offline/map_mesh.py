"""Meshes of maps that are in memory, made by the same code as a server's tiles. Needs numba."""

from collections.abc import Callable

from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Doubles
from triquad_map.composition.composed_view import ComposedView
from triquad_map.mesh.tile_mesh import TileIndex, TileLattice, mesh_tile
from triquad_map.triangles import TileJoin, Triangles

from triquad_client.mesh.mesh import Mesh

MAX_FACES = 50_000_000

TILE_CELLS = 64
"""The cells along each side of a tile, as in a server's mesh."""

WHOLE_TILE_CELLS = 128
"""The same where all tiles are made in a row: larger ones search less around them again."""

Report = Callable[[int, int], None]
"""A function that is called with how many tiles are done, and of how many."""


def map_lattice(cell_m: float, reach_m: float, *, whole: bool) -> TileLattice:
    """Return the lattice of a map's tiles; ``whole``: all of them are made in a row."""
    return TileLattice(cell_m, WHOLE_TILE_CELLS if whole else TILE_CELLS, reach_m)


class MapTiles:
    """The surface of a map, cut into cubes that are meshed one by one; for several threads.

    Each face is in one tile. Tiles agree on the lattice points that they share, so there are no
    gaps between them.
    """

    def __init__(
        self,
        view: ComposedView,
        ends: Doubles,
        lattice: TileLattice,
        box: tuple[Doubles, Doubles],
        fill_m: float,
        origin: Doubles,
    ) -> None:
        """Use ``OfflineMap.mesh_tiles``.

        Args:
            view: the map.
            ends: [N, 3] middles of the voxels in which rays ended, metres from its origin.
            lattice: where the tiles lie.
            box: corners [3] of what is to be meshed, metres, map frame.
            fill_m: how far from seen surface holes are filled, metres.
            origin: [3] of the map.
        """
        self._view = view
        self._lattice = lattice
        self._box = box[0] - origin, box[1] - origin
        self.origin = origin
        self._fill_m = fill_m
        self.side_m = lattice.tile_side_m
        """The side of a tile."""
        half_m = view.voxel_m / 2
        tiles = lattice.tiles_meeting(ends - half_m, ends + half_m, lattice.reach_m + fill_m)
        self.indices: list[TileIndex] = [
            (x, y, z) for x, y, z in tiles[lattice.meets(tiles, *self._box)].tolist()
        ]
        """The tiles in which there may be faces: their least corners, in sides of a tile from
        the map's origin."""

    def mesh(self, index: TileIndex) -> Mesh:
        """Return all faces in one of :attr:`indices`."""
        return Mesh.of(self._made(index).moved(self.origin), self._view.epoch)

    def joined(self, report: Report | None) -> Mesh:
        """Return the faces of all tiles whose centroids lie in the box.

        Raises:
            InvalidInputError: there are more than 50 million faces.
        """
        join = TileJoin(self.side_m, self._box, marked=self._fill_m > 0)
        faces = 0
        for number, index in enumerate(self.indices, start=1):
            part = self._made(index)
            join.add(part)
            faces += len(part.faces)
            if faces > MAX_FACES:
                raise InvalidInputError(
                    f"the mesh has more than {MAX_FACES:,} faces with cells of "
                    f"{self._lattice.cell_m:g} m: ask for a smaller box, or larger cells"
                )
            if report is not None:
                report(number, len(self.indices))
        return Mesh.of(join.mesh().moved(self.origin), self._view.epoch)

    def _made(self, index: TileIndex) -> Triangles:
        """Return all faces in a tile, from the map's origin."""
        return mesh_tile(self._view, index, self._lattice, fill_m=self._fill_m).triangles
