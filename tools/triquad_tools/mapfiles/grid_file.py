"""A map as the arrays of a grid, in a file of numpy (``.npz``)."""

from pathlib import Path

import numpy as np
from triquad_client import OfflineMap
from triquad_format.mapfile.files import replacing
from triquad_map.questions.grid import GridShape

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box, NothingLeftError

REACH_M = 5.0
"""Distances in a grid file end here, as those of ``query_grid`` do by default."""

_MAX_CELLS = 100_000_000  # as of query_grid: two minutes of a core, and 1 GB of memory


def write_grid(opened: OfflineMap, path: Path, box: Box | None, cell_m: float | None) -> str:
    """Write distance and status of a map at the middles of a grid's cells.

    The arrays are named as those of :class:`triquad_client.Grid`: ``distance_m`` and ``status``
    [x, y, z], ``corner`` [3], ``cell_m`` and ``epoch``; also ``max_distance_m``, and ``axes``.

    Args:
        opened: the map.
        path: the file to write.
        box: what the grid fills; ``None``: the box around all seen surface.
        cell_m: side of a cell; ``None``: a leaf.

    Returns:
        What was written, in words.

    Raises:
        NothingLeftError: no surface was seen, and there is no box.
        ToolError: the grid is too large.
        OSError: the file cannot be written.
    """
    filled = surface_box(opened, path) if box is None else box
    shape = checked_shape(path, filled, opened.leaf_m if cell_m is None else cell_m)
    with progress("asking"):
        found = opened.query_grid((filled[0].tolist(), filled[1].tolist()), shape.cell_m, REACH_M)
    with replacing(path) as stream:
        np.savez_compressed(
            stream,
            distance_m=found.distance_m,
            status=found.status.view(np.ndarray),
            corner=found.shape.corner,
            cell_m=np.float64(found.shape.cell_m),
            max_distance_m=np.float64(REACH_M),
            axes=np.array(["x", "y", "z"]),
            epoch=np.int64(found.epoch),
        )
    sides = " x ".join(map(str, found.shape.counts))
    return f"{path.stat().st_size:,} bytes, {sides} cells of {found.shape.cell_m:g} m"


def surface_box(opened: OfflineMap, path: Path) -> Box:
    """Return the box around all voxels in which rays ended.

    Raises:
        NothingLeftError: there are none; it names the file that is not written.
    """
    middles, half_m = opened.surface_voxels(), opened.leaf_m / 2
    if not len(middles):
        raise NothingLeftError(f"{path} is not written: no surface was seen")
    return np.stack([middles.min(axis=0) - half_m, middles.max(axis=0) + half_m])


def checked_shape(path: Path, box: Box, cell_m: float, *, layers: int | None = None) -> GridShape:
    """Return the cells that fill a box; those at its greater sides may jut out.

    Args:
        path: the file that has them.
        box: what is filled.
        cell_m: side of a cell.
        layers: of cells along z; ``None``: as many as fill the box.

    Raises:
        ToolError: there are more than 100 million; it names the file.
    """
    x, y, z = (int(count) for count in np.maximum(np.ceil((box[1] - box[0]) / cell_m - 1e-6), 1))
    shape = GridShape(box[0], cell_m, (x, y, z if layers is None else layers))
    if shape.cells > _MAX_CELLS:
        sides = " x ".join(
            f"{count:,}" if count < _MAX_CELLS else "very many" for count in shape.counts
        )
        raise ToolError(
            f"{path} would have {sides} cells of {cell_m:g} m, more than {_MAX_CELLS:,} of them: "
            "use --crop, or a larger --cell, of triquad-pack"
        )
    return shape
