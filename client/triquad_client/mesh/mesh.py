"""A surface as triangles: fetched, joined from the meshes of tiles, and written to files.

What is fetched goes in the background of all else.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import InvalidInputError
from triquad_format.records.arrays import Bools, Doubles, Ints, Longs
from triquad_format.wire import keys
from triquad_format.wire.messages import Tile, TileList, TileListRequest, TileRequest

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import BadReplyError, DownloadError
from triquad_client.net.call import NEWEST, Ask, Call, Run, ask, ask_each, offload, retried

if TYPE_CHECKING:
    import trimesh

_TILES_AT_A_TIME = 128
"""Are fetched before it is asked whether they are too much."""

WELD_M = 1e-4
"""Vertices closer than about this are one."""

_SHIFTS = np.array([(0.5, 0.5, 0.5), (0, 0.5, 0.5), (0.5, 0, 0.5), (0.5, 0.5, 0)])
"""Vertices that lie on a lattice edge may fall on two sides of a rounding boundary along it, and
along it only: a second round, shifted along that axis, brings them together."""

_Y_UP = np.array([(1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1.0)])
"""The map's axes, of which z points upwards, as those of a glTF scene."""

_PLY_FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])
_PLY_MARKED_FACE = np.dtype([*_PLY_FACE.descr, ("filled", "u1")])


@dataclass(frozen=True)
class Mesh:
    """Triangles of the map frame."""

    vertices: NDArray[np.float64]  # [V, 3] metres
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space
    epoch: int = 0  # number of the published state of the map that it shows; 0: of none
    # [F] whether no ray has met the surface there: it is continued from what was seen, and the
    # status there is UNKNOWN; None where no holes were to be filled
    filled: Bools | None = None

    def save(self, path: str | Path) -> None:
        """Write the mesh to a file: ``.ply``, or ``.glb``, ``.obj`` or ``.stl`` with trimesh.

        A ``.ply`` is exact (double precision), an ``.obj`` has eight decimals, an ``.stl`` is of
        single precision: half a metre where coordinates are as large as UTM northings. So are
        the positions in a ``.glb``, but relative to the middle of the mesh: its node moves them
        back, and turns the map's z axis to the y axis that points upwards in a glTF scene.

        Where holes were filled, a ``.ply`` marks the faces by their property ``filled``, 1 or 0;
        a ``.glb`` and an ``.obj`` have two meshes, ``seen`` and ``filled``.

        Raises:
            InvalidInputError: the name ends otherwise, trimesh is not installed, or holes were
                filled, which an ``.stl`` cannot tell.
            OSError: the file cannot be written.
        """
        Path(path).write_bytes(self.file_bytes(Path(path).suffix))

    def file_bytes(self, suffix: str) -> bytes:
        """What :meth:`save` writes to a file whose name ends in ``suffix``, such as ``".ply"``.

        Raises:
            InvalidInputError: there is no such format, or trimesh is not installed.
        """
        encode = _FORMATS.get(suffix.lower())
        if encode is None:
            raise InvalidInputError(f"suffix = {suffix!r}: use one of {', '.join(_FORMATS)}")
        return encode(self)

    def to_trimesh(self) -> "trimesh.Trimesh":
        """A copy for the library trimesh.

        Raises:
            InvalidInputError: trimesh is not installed.
        """
        try:
            import trimesh
        except ImportError as error:
            raise InvalidInputError("trimesh is missing: pip install 'triquad[mesh]'") from error
        return trimesh.Trimesh(self.vertices.copy(), self.faces.copy(), process=False)


def fetch_tiles(bounds: Bounds | None, level: int, fill_m: float = 0.0) -> Call[TileList]:
    """The tiles that meet the bounds."""
    minimum, maximum = checks.box(bounds)
    request = TileListRequest(
        minimum,
        maximum,
        NEWEST,
        level=checks.level_of_detail(level),
        fill_m=checks.length_to_fill(fill_m),
    )
    return (yield from ask(Ask(keys.TILE_LIST, request, TileList, background=True)))


def fetch_tile(index: Sequence[int], level: int) -> Call[Mesh]:
    """The newest mesh of one tile."""
    tile = yield from ask(_ask_tile(index, NEWEST, checks.level_of_detail(level), fill_m=0.0))
    return _mesh_of(tile)


def fetch_mesh(
    bounds: Bounds | None, level: int, max_bytes: int, fill_m: float = 0.0
) -> Call[Mesh]:
    """The faces whose centroids lie in the bounds, from one epoch.

    Raises:
        BadReplyError: holes were to be filled, which a server of an earlier release does not do.
        DownloadError: its tiles take more than ``max_bytes``.
    """
    box = checks.box(bounds)

    def fetch() -> Call[Mesh]:
        listed = yield from fetch_tiles(bounds, level, fill_m)
        indices = listed.tiles.tolist()
        tiles: list[Tile] = []
        for start in range(0, len(indices), _TILES_AT_A_TIME):
            part = indices[start : start + _TILES_AT_A_TIME]
            tiles += yield from ask_each(
                part, lambda at: _ask_tile(at, listed.epoch, level, fill_m=fill_m)
            )
            if fill_m > 0 and any(tile.filled is None for tile in tiles):
                raise BadReplyError("the reply lacks filled, which was asked for by fill_m")
            if sum(tile.vertices.nbytes + tile.faces.nbytes for tile in tiles) > max_bytes:
                raise too_large_error(max_bytes)

        def join(_: Run) -> Mesh:
            parts = [_mesh_of(tile) for tile in tiles]
            return joined(parts, listed.tile_side_m, box=box, epoch=listed.epoch, marked=fill_m > 0)

        return (yield from offload(join))

    return (yield from retried("epoch_gone", fetch))


def too_large_error(max_bytes: int) -> DownloadError:
    """The error for a mesh of more bytes."""
    return DownloadError(
        f"the mesh takes more than {max_bytes} bytes: ask for a smaller box or a coarser level, or "
        "connect with a larger max_download_bytes"
    )


def _ask_tile(index: Sequence[int], epoch: int, level: int, fill_m: float) -> Ask[Tile]:
    x, y, z = index
    request = TileRequest(x, y, z, epoch=epoch, level=level, fill_m=fill_m)
    return Ask(keys.TILE, request, Tile, background=True)


def _mesh_of(tile: Tile) -> Mesh:
    marks = None if tile.filled is None else tile.filled.astype(np.bool_)
    return Mesh(tile.origin + tile.vertices, tile.faces, tile.epoch, filled=marks)


def joined(
    tiles: Sequence[Mesh],
    tile_side_m: float,
    *,
    box: tuple[Doubles, Doubles],
    epoch: int,
    marked: bool = False,
) -> Mesh:
    """The tiles' faces whose centroids lie in a box, given by its corners [3], as one mesh.

    Where the tiles are ``marked``, all tell which faces fill holes.
    """
    cut = [_within(tile, box) for tile in tiles]
    starts = np.cumsum([0, *(len(tile.vertices) for tile in cut)])
    shifted = [tile.faces + np.int32(start) for tile, start in zip(cut, starts, strict=False)]
    marks = [tile.filled for tile in cut if tile.filled is not None]
    whole = welded(
        np.concatenate([np.zeros((0, 3)), *(tile.vertices for tile in cut)]),
        np.concatenate([np.zeros((0, 3), np.int32), *shifted]),
        tile_side_m,
        filled=np.concatenate([np.zeros(0, np.bool_), *marks]) if marked else None,
    )
    return dataclasses.replace(whole, epoch=epoch)


def _within(tile: Mesh, box: tuple[Doubles, Doubles]) -> Mesh:
    """The faces of a tile whose centroids lie in a box; all of its vertices stay."""
    low, high = box
    if ((tile.vertices >= low) & (tile.vertices <= high)).all():
        return tile
    centroids = tile.vertices[tile.faces].mean(axis=1)
    inside = ((centroids >= low) & (centroids <= high)).all(axis=1)
    filled = None if tile.filled is None else tile.filled[inside]
    return dataclasses.replace(tile, faces=tile.faces[inside], filled=filled)


def welded(vertices: Doubles, faces: Ints, tile_side_m: float, filled: Bools | None = None) -> Mesh:
    """The mesh with one vertex where tiles had several, without faces that this made degenerate.

    Of ``vertices`` [V, 3], metres, only those on the sides of tiles, ``tile_side_m`` long, can be
    the same; ``filled`` [F] is as of :class:`Mesh`.
    """
    steps = vertices / tile_side_m
    steps -= np.rint(steps)
    near = np.abs(steps, out=steps) < WELD_M / tile_side_m
    shared = np.flatnonzero(near[:, 0] | near[:, 1] | near[:, 2])
    target = np.arange(len(vertices), dtype=np.int32)
    target[shared] = shared[_representatives(vertices[shared])]
    joined = target.take(faces)
    a, b, c = joined.T
    kept = (a != b) & (b != c) & (c != a)
    return compacted(vertices, joined[kept], filled=None if filled is None else filled[kept])


def compacted(
    vertices: Doubles,
    faces: NDArray[np.integer],
    epoch: int = 0,
    filled: Bools | None = None,
) -> Mesh:
    """The mesh without vertices that no face uses."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return Mesh(vertices[used], number.take(faces).reshape(-1, 3), epoch, filled)


def _representatives(points: Doubles) -> NDArray[np.intp]:
    """For each point [N, 3], the index of the point that stands for it."""
    chosen = np.arange(len(points))
    for shift in _SHIFTS:
        left, at = np.unique(chosen, return_inverse=True)
        names = _names(np.floor(points[left] / WELD_M + shift).astype(np.int64))
        _, first, inverse = np.unique(names, return_index=True, return_inverse=True)
        chosen = left[first[inverse]][at]
    return chosen


def _names(cells: Longs) -> Longs:
    """A number for each of cells [N, 3], the same one for the same cell alone."""
    if len(cells) == 0:
        return np.zeros(0, np.int64)
    x, y, z = (axis - axis.min() for axis in cells.T)
    # By way of the columns in use: 64 bits would not do for all cells of a large map.
    _, columns = np.unique(x * (y.max() + 1) + y, return_inverse=True)
    names: Longs = columns * (z.max() + 1) + z
    return names


def _ply(mesh: Mesh) -> bytes:
    """Binary PLY in double precision; that of trimesh is single, and this one needs no library."""
    marked = mesh.filled is not None
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment triquad, metres\n"
        f"element vertex {len(mesh.vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\n"
        f"{'property uchar filled' + chr(10) if marked else ''}end_header\n"
    )
    rows = np.empty(len(mesh.faces), _PLY_MARKED_FACE if marked else _PLY_FACE)
    rows["count"] = 3
    rows["indices"] = mesh.faces
    if marked:
        rows["filled"] = mesh.filled
    return header.encode("ascii") + mesh.vertices.astype("<f8").tobytes() + rows.tobytes()


def _glb(mesh: Mesh) -> bytes:
    middle = mesh.to_trimesh().bounds.mean(axis=0) if len(mesh.faces) else np.zeros(3)
    scene = _scene(dataclasses.replace(mesh, vertices=mesh.vertices - middle))
    back = _Y_UP.copy()
    back[:3, 3] = _Y_UP[:3, :3] @ middle
    scene.apply_transform(back)
    return _exported(scene, "glb")


def _obj(mesh: Mesh) -> bytes:
    return _exported(mesh.to_trimesh() if mesh.filled is None else _scene(mesh), "obj")


def _stl(mesh: Mesh) -> bytes:
    if mesh.filled is not None:
        raise InvalidInputError(
            "an .stl cannot tell which faces fill holes: use .ply, .glb or .obj, or no fill_m"
        )
    return _exported(mesh.to_trimesh(), "stl")


def _scene(mesh: Mesh) -> "trimesh.Scene":
    """The mesh in a scene; where holes were filled, in two parts, ``seen`` and ``filled``."""
    whole = mesh.to_trimesh()
    if mesh.filled is None or not len(mesh.faces):
        return whole.scene(camera=None)
    import trimesh

    scene = trimesh.Scene()
    for name, chosen in (("seen", ~mesh.filled), ("filled", mesh.filled)):
        if chosen.any():
            part = compacted(mesh.vertices, mesh.faces[chosen])
            scene.add_geometry(part.to_trimesh(), node_name=name, geom_name=name)
    return scene


def _exported(surface: "trimesh.Trimesh | trimesh.Scene", kind: str) -> bytes:
    data = surface.export(file_type=kind)
    return data.encode("ascii") if isinstance(data, str) else cast(bytes, data)


_FORMATS: dict[str, Callable[[Mesh], bytes]] = {
    ".ply": _ply,
    ".glb": _glb,
    ".obj": _obj,
    ".stl": _stl,
}
