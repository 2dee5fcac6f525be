"""Signed distances on a lattice, for programs that want an array.

Lattice points are the multiples of the cell side, as those of the server's meshes. What the field
says is given wherever a region is, trusted or not; see the status. Elsewhere the distance is NaN
and the status ``UNKNOWN``. ``docs/tools.md`` defines the arrays.
"""

import math
from pathlib import Path

import numpy as np
from triquad_format.mapfile.durable_file import replacing
from triquad_format.records.region import MapRecord
from triquad_format.records.seen_space import evidence_bounds
from triquad_map.record_view import open_view

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box

MAX_CELLS = 200_000_000

_POINTS_AT_ONCE = 1 << 20
_ROUNDING = 1e-9


def export_grid(record: MapRecord, box: Box | None, cell_m: float, path: Path) -> str:
    """Write distances at all lattice points in a box as a numpy archive; return what was written.

    Raises:
        ToolError: the grid is too large, or there is nothing to fill.
        OSError: the file cannot be written.
    """
    filled = box if box is not None else evidence_bounds(record)
    if filled is None:
        raise ToolError("no ray has shown anything of this map: there is no box to fill")
    corners = list(zip(filled[0].tolist(), filled[1].tolist(), strict=True))
    sides = [(high - low) / cell_m for low, high in corners]
    if math.prod(side + 1 for side in sides) > MAX_CELLS:  # at most this many points
        raise ToolError(
            f"the grid would have {' x '.join(f'{side:.6g}' for side in sides)} = "
            f"{math.prod(sides):.3g} points, more than {MAX_CELLS:,}: use --crop or a larger --cell"
        )
    low = [math.ceil(low / cell_m - _ROUNDING) for low, _ in corners]
    last = [math.floor(high / cell_m + _ROUNDING) for _, high in corners]
    shape = tuple(max(end - start + 1, 0) for start, end in zip(low, last, strict=True))
    first, count = np.array(low, np.float64), math.prod(shape)
    sdf, status = np.empty(count, np.float32), np.empty(count, np.uint8)
    view = open_view(record).view
    with progress("evaluating", 1.0) as report:
        for start in range(0, count, _POINTS_AT_ONCE):
            end = min(start + _POINTS_AT_ONCE, count)
            cells = np.stack(np.unravel_index(np.arange(start, end), shape), axis=1)
            answer = view.query((first + cells) * cell_m)
            sdf[start:end], status[start:end] = answer.sdf, answer.status
            report(end / count, f"{end:,} points")
    with replacing(path) as stream:
        np.savez(
            stream,
            epoch=record.epoch,
            cell_m=cell_m,
            origin_m=first * cell_m,
            sdf=sdf.reshape(shape),
            status=status.reshape(shape),
        )
        size = stream.tell()
    return f"{size:,} bytes, distances {' x '.join(map(str, shape))}"
