"""Questions about points and boxes of the map.

:mod:`triquad_map.questions.answers` is the other side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.wire.limits import MAX_QUERY_POINTS, MAX_SEARCHES
from triquad_format.wire.messages import SdfRequest
from triquad_format.wire.query_messages import DistanceRequest, GridRequest, SpheresRequest
from triquad_map.questions.answer import Answer
from triquad_map.questions.bodies import Spheres
from triquad_map.questions.distance import Distances, Unknown, UnknownLike, with_unknown
from triquad_map.questions.grid import Grid
from triquad_map.view import FieldAnswer

from triquad_client import checks
from triquad_client.calls.questions_in_parts import Asking, Part
from triquad_client.checks import Bounds
from triquad_client.net.connection import NEWEST, Answering, retried


@dataclass(frozen=True, repr=False)
class SdfResult(Answer, FieldAnswer):
    """The field and the status of N points, all of it from one epoch.

    Attributes:
        sdf: [N] metres, positive in free space; NaN where no region is.
        status: [N] :class:`Status`.
    """

    epoch: int


class PointQueries(Asking):
    """Questions about points and boxes; see :class:`MapQueries`."""

    def query_sdf(
        self, points: ArrayLike, gradient: bool = False, at_epoch: int | None = None
    ) -> SdfResult:
        """Return the trained field at ``points`` [N, 3]: right near surfaces, saturated beyond.

        Where the map has no region, which is far from all that was seen, field and gradient are
        NaN.

        Args:
            points: metres, map frame.
            gradient: whether the gradient is wanted.
            at_epoch: see :class:`MapQueries`.
        """
        wanted, checked = checks.flag("gradient", gradient), checks.query_points(points)

        def request(part: Part) -> SdfRequest:
            return SdfRequest(part.origin, part.offsets(checked), wanted, epoch=part.epoch)

        answered = self._in_parts(request, checked, most=MAX_QUERY_POINTS, at_epoch=at_epoch)
        return SdfResult(**answered.joined(asked_for={"gradient": wanted}))

    def query_distance(
        self,
        points: ArrayLike,
        max_distance_m: float = 5.0,
        *,
        unknown: UnknownLike = Unknown.FREE,
        surface_point: bool = False,
        unknown_distance: bool = False,
        at_epoch: int | None = None,
    ) -> Distances:
        """Return true distances to the nearest seen surface, with gradients, at ``points`` [N, 3].

        Args:
            points: metres, map frame.
            max_distance_m: surfaces are searched for up to here, at most 100 m.
            unknown: ``"obstacle"`` lets unknown space count as a surface, ``"error"`` refuses
                points to which it is nearer.
            surface_point: whether the nearest points of the surface are wanted.
            unknown_distance: whether the distance to unknown space is wanted.
            at_epoch: see :class:`MapQueries`.

        Raises:
            UnknownSpaceError: ``unknown`` is ``"error"`` and unknown space is nearer somewhere.
        """
        checked, policy = checks.query_points(points), Unknown(unknown)
        with_point = checks.flag("surface_point", surface_point)
        with_distance = checks.flag("unknown_distance", unknown_distance)
        with_distance = with_distance or policy is not Unknown.FREE
        reach_m = checks.within("max_distance_m", max_distance_m)

        def request(part: Part) -> DistanceRequest:
            offsets = part.offsets(checked)
            return DistanceRequest(
                part.origin, offsets, reach_m, with_point, with_distance, part.epoch
            )

        answered = self._in_parts(request, checked, most=MAX_SEARCHES, at_epoch=at_epoch)
        asked_for = {"surface_point": with_point}
        asked_for |= dict.fromkeys(("unknown_distance_m", "unknown_point"), with_distance)
        fields = answered.joined(
            flags=["found"], placed=["surface_point", "unknown_point"], asked_for=asked_for
        )
        return with_unknown(Distances(**fields), checked, policy)

    def query_spheres(
        self, centres: ArrayLike, radii_m: ArrayLike, at_epoch: int | None = None
    ) -> Spheres:
        """Return what spheres at ``centres`` [N, 3] contain; ``radii_m`` are one or [N], metres."""
        checked = checks.query_points(centres)
        radii = checks.radii(radii_m, len(checked))

        def request(part: Part) -> SpheresRequest:
            offsets = part.offsets(checked)
            return SpheresRequest(part.origin, offsets, radii[part.rows], epoch=part.epoch)

        answered = self._in_parts(request, checked, most=MAX_SEARCHES, at_epoch=at_epoch)
        return Spheres(**answered.joined())

    def query_grid(
        self,
        bounds: Bounds,
        cell_m: float = 0.1,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Grid:
        """Return distance and status at the cubic cells that fill ``bounds``.

        Args:
            bounds: corners of a box; where both have the same z, the grid is a slice there.
            cell_m: side of a cell.
            max_distance_m: surfaces are searched for up to here, at most 100 m.
            at_epoch: see :class:`MapQueries`.
        """
        shape = checks.grid_shape(bounds, cell_m)
        reach_m = checks.within("max_distance_m", max_distance_m)
        blocks = grid_blocks(shape.counts)
        firsts = np.array([block.first for block in blocks])

        def request(part: Part) -> GridRequest:
            (block,) = blocks[part.rows]
            counts = np.array(block.counts, np.int32)
            return GridRequest(part.origin, shape.cell_m, counts, reach_m, epoch=part.epoch)

        corners = shape.corner + firsts * shape.cell_m
        answered = self._in_parts(request, corners, most=1, at_epoch=at_epoch)
        fields = answered.joined(flat=("distance_m", "status"))
        for name in ("distance_m", "status"):
            fields[name] = fields[name].reshape(shape.counts)
        return Grid(shape, **fields)


@dataclass(frozen=True)
class GridBlock:
    """Cells of a grid that lie one after the other, z running fastest."""

    first: tuple[int, int, int]
    counts: tuple[int, int, int]


def grid_blocks(counts: tuple[int, int, int]) -> list[GridBlock]:
    """Return a grid in blocks for one request each: layers of one x each, or parts of one."""
    columns, rows, height = counts
    rows_each = min(rows, max(1, MAX_SEARCHES // height))
    columns_each = max(1, MAX_SEARCHES // (rows * height))
    return [
        GridBlock((x, y, 0), (min(columns_each, columns - x), min(rows_each, rows - y), height))
        for x in range(0, columns, columns_each)
        for y in range(0, rows, rows_each)
    ]


def pin_newest(server: Answering) -> int:
    """Return the newest epoch, once the server keeps it for us: it was asked for by number."""

    def epoch_of(epoch: int) -> int:
        request = SdfRequest(np.zeros(3), np.zeros((0, 3), np.float32), False, epoch)
        return server.ask(request).epoch

    return retried("epoch_gone", lambda: epoch_of(epoch_of(NEWEST)))
