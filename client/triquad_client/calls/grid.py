"""Grids of distance and status."""

import numpy as np
from triquad_format.wire import keys
from triquad_format.wire.query_messages import GridReply, GridRequest
from triquad_map.questions.grid import Grid, GridShape

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import InvalidInputError
from triquad_client.net.call import Ask, Call
from triquad_client.net.parts import in_parts

PART_CELLS = 20_000
"""Cells of one request, unless a layer has more."""

MAX_CELLS = 100_000_000


def query(bounds: Bounds, cell_m: float, max_distance_m: float, at_epoch: int | None) -> Call[Grid]:
    """The map at the cells that fill ``bounds``; a flat box is one layer of them."""
    shape = _shape(bounds, checks.within("cell_m", cell_m))
    reach_m = checks.within("max_distance_m", max_distance_m)
    columns, *layer = shape.counts
    at_once = max(1, PART_CELLS // (layer[0] * layer[1]))

    def request(part: slice, number: int) -> Ask[GridReply]:
        corner = shape.corner + (part.start * shape.cell_m, 0.0, 0.0)
        count = min(part.stop, columns) - part.start
        counts = np.array([count, *layer], np.int32)
        message = GridRequest(
            corner=corner, cell_m=shape.cell_m, counts=counts, max_distance_m=reach_m, epoch=number
        )
        return Ask(keys.GRID, message, GridReply)

    epoch = checks.chosen_epoch(at_epoch)
    parts = yield from in_parts(columns, at_once, request, epoch)
    return Grid(
        shape=shape,
        distance_m=np.concatenate([part.distance_m for part in parts]),
        status=np.concatenate([part.status for part in parts]),
        epoch=parts[0].epoch,
    )


def _shape(bounds: Bounds, cell_m: float) -> GridShape:
    low, high = checks.box(bounds)
    if not np.isfinite([low, high]).all():
        raise InvalidInputError(f"bounds = {bounds!r}: a grid needs finite ones")
    counts = np.maximum(np.ceil((high - low) / cell_m - 1e-6), 1.0)
    if counts.prod() > MAX_CELLS:
        raise InvalidInputError(
            f"{counts.prod():.3g} cells of {cell_m:g} m in {bounds!r}: "
            f"ask for at most {MAX_CELLS:g}"
        )
    # A flat box lies in the middle of its layer.
    corner = np.where(high > low, low, low - cell_m / 2)
    return GridShape(corner, cell_m, (int(counts[0]), int(counts[1]), int(counts[2])))
