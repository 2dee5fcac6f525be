"""A map in memory, such as one of a file, that answers as a server does, without one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike
from triquad_format.errors import RefusedError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files, map_folder
from triquad_format.mapfile.reader import read_map_file
from triquad_format.records.arrays import Bools, Doubles
from triquad_format.records.region import MapRecord, surface_voxels
from triquad_format.wire.codec import Request, asked_from
from triquad_format.wire.limits import MAX_FILL_M
from triquad_map.opening import open_view
from triquad_map.questions.answers import Answers
from triquad_map.view import MapView

from triquad_client import checks
from triquad_client.calls.queries import MapQueries
from triquad_client.checks import Bounds
from triquad_client.errors import ClosedError, brief, brief_errors
from triquad_client.mesh.mesh import Mesh
from triquad_client.net.connection import Answering, ReplyT

if TYPE_CHECKING:
    from triquad_map.composition.composed_view import RecordedView

    from triquad_client.offline.map_mesh import MapTiles, Report

CELL_RANGE_M = (0.005, 10.0)
_CELL_LEAVES = 0.5
REACH_LEAVES = 0.1  # how far from a voxel with seen surface the middle of a face may lie


class LocalMap(Answering):
    """Answers requests about the map in a record, as fast as possible here; for several threads."""

    def __init__(self, record: MapRecord, *, local: bool = False) -> None:
        self._opened: RecordedView | None = open_view(record)
        self._answers = Answers(self._epoch)
        self.origin = record.origin * (not local)
        """[3] from where the map counts, in the coordinates of requests: 0 if those are local."""

    @property
    def view(self) -> RecordedView:
        """The map.

        Raises:
            ClosedError: it was closed.
        """
        if self._opened is None:
            raise ClosedError("the map is closed")
        return self._opened

    def close(self) -> None:
        """Release the map; what is asked later raises :class:`ClosedError`."""
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()

    def replies(self, requests: Iterable[Request[ReplyT]]) -> Iterator[ReplyT]:
        """Yield the reply to each request, one after the other."""
        return (asked_from(self.origin, self._answers.answer, request) for request in requests)

    @contextmanager
    def _epoch(self, number: int) -> Iterator[MapView]:
        """Yield the view, where its epoch is asked for, or the newest."""
        view = self.view
        if number not in (0, view.epoch):
            raise RefusedError("epoch_gone", f"epoch {number} is not kept; kept is [{view.epoch}]")
        yield view


@brief_errors
class OfflineMap(MapQueries):
    """A map in memory; several threads may ask it.

    Its queries are those of :class:`Client`, with the same results and errors; the epoch is always
    the same.
    """

    def __init__(self, record: MapRecord, stamp_ns: int = 0, *, coordinates: str = "map") -> None:
        """Open a map that is in memory already; use :func:`open_map` for a file."""
        self._server = self._map = LocalMap(record, local=checks.are_local(coordinates))
        # Meshes need no more of it: the view has the rest in a form of its own.
        self._seen = dataclasses.replace(
            record,
            regions=tuple(
                dataclasses.replace(region, tables=(), training=None) for region in record.regions
            ),
        )
        self.name = record.name
        self.epoch = record.epoch
        self.origin_m = record.origin
        """[3] metres, map frame: from where the map itself counts."""
        self.leaf_m = record.settings.leaf_m
        """Side of the voxels in which rays ended."""
        self.stamp_ns = stamp_ns
        """The time when its epoch was written, nanoseconds since 1970; 0: the file does not say."""

    def __repr__(self) -> str:
        regions = len(self._seen.regions)
        return f"OfflineMap({self.name!r}, {regions} regions; epoch {self.epoch})"

    def __enter__(self) -> OfflineMap:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the map; later queries raise :class:`ClosedError`."""
        self._map.close()

    def mesh(
        self,
        bounds: Bounds | None = None,
        cell_m: float | None = None,
        report: Report | None = None,
        fill_m: float = 0.0,
    ) -> Mesh:
        """Return the surface that rays have seen, by marching cubes: faces centred in ``bounds``.

        Args:
            bounds: corners of a box, metres, map frame; ``None``: everywhere.
            cell_m: side of the cells, 0.005 to 10 m; ``None``: half a leaf, 0.1 m unless the map
                was made with others, as in a server's mesh.
            report: is called after each tile with how many are done, and of how many.
            fill_m: also the surface up to so far from what was seen, 0 to 5 m, where the field
                continues it into ``UNKNOWN`` space; those faces are marked in ``Mesh.filled``.

        Raises:
            InvalidInputError: the bounds are not a box, the cells or ``fill_m`` are out of range,
                or there are more than 50 million faces.
            ClosedError: the map was closed.
        """
        return self._tiles(cell_m, bounds, fill_m, whole=True).joined(report)

    def mesh_tiles(self, cell_m: float | None = None) -> MapTiles:
        """Return the surface as :meth:`mesh` has it, everywhere, to be made tile by tile.

        Args:
            cell_m: as of :meth:`mesh`.

        Raises:
            InvalidInputError: the cells are out of range.
            ClosedError: the map was closed.
        """
        return self._tiles(cell_m, None, 0.0, whole=False)

    def _tiles(
        self, cell_m: float | None, bounds: Bounds | None, fill_m: float, *, whole: bool
    ) -> MapTiles:
        view = self._map.view
        chosen_m = _CELL_LEAVES * self.leaf_m if cell_m is None else cell_m
        checked_m = checks.within("cell_m", chosen_m, CELL_RANGE_M[1], least=CELL_RANGE_M[0])
        box, fill_m = checks.box(bounds), checks.within("fill_m", fill_m, MAX_FILL_M, least=0.0)
        from triquad_client.offline.map_mesh import MapTiles, map_lattice

        lattice = map_lattice(checked_m, REACH_LEAVES * self.leaf_m, whole=whole)
        ends = surface_voxels(self._seen)
        return MapTiles(view, ends, lattice, box, fill_m, origin=self._map.origin)

    def surface_voxels(self) -> Doubles:
        """Return middles [N, 3] of the voxels in which rays ended, metres, map frame."""
        return surface_voxels(self._seen) + self._map.origin

    def has_surface(self, points: ArrayLike) -> Bools:
        """Return whether :meth:`mesh` may have faces [N] at ``points`` [N, 3], metres, map frame.

        It has where the field is zero within a tenth of a leaf of a voxel in which rays ended, and
        not next to where they ended in it.

        Raises:
            InvalidInputError: the points are not [N, 3], or not finite.
            ClosedError: the map was closed.
        """
        places = checks.query_points(points) - self._map.origin
        return self._map.view.near_ends(places, REACH_LEAVES * self.leaf_m)


@brief
def open_map(path: str | Path, *, coordinates: str = "map") -> OfflineMap:
    """Return the map in a file, read whole and checked.

    It is answered as fast as by a server, by compiled code: that takes numba. The surfels, on which
    distances depend, are made at the first question that needs them: half a second for 100 m of
    street.

    Args:
        path: a map file, or a server's store, of which the newest checkpoint is read.
        coordinates: ``"map"``: all places are in the map frame, as the poses of its scans were;
            ``"local"``: they are relative to :attr:`OfflineMap.origin_m`.

    Raises:
        MapFileError: it is no map file, is damaged, or needs a newer reader.
        OSError: it cannot be read.
        NoCompiledCodeError: numba is missing: ``pip install 'triquad[fast]'``.
    """
    chosen = Path(path)
    if chosen.is_dir():
        chosen = checkpoint_files(map_folder(chosen))[0].path
    file = read_map_file(chosen)
    return OfflineMap(file.record, file.manifest.stamp_ns, coordinates=coordinates)
