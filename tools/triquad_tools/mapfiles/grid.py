"""Signed distances on a lattice, for programs that want an array: dense, or where surface is.

Lattice points are the multiples of the cell side, as those of the server's meshes. What the field
says is given wherever a region is, trusted or not; see the status. Elsewhere the distance is NaN
and the status ``UNKNOWN``. ``docs/tools.md`` defines the arrays.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from triquad_format.mapfile.durable_file import replacing
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.cells import cells_of_boxes
from triquad_format.records.region import MapRecord
from triquad_format.records.seen_space import evidence_bounds, surface_voxels
from triquad_map.record_view import open_view
from triquad_map.view import MapView

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.source import Box

MAX_CELLS = 200_000_000

BLOCK_CELLS = 8
"""Lattice points along the side of a block."""

BAND_CELLS = 3
"""The least reach of a sparse grid around seen surface, on each axis."""

_POINTS_AT_ONCE = 1 << 20
_ROUNDING = 1e-9

Arrays = dict[str, Any]
"""Arrays by their names in the archive."""

Positions = Callable[[Longs], Doubles]
"""The places [N, 3] of numbered lattice points, metres, map frame."""


def export_grid(record: MapRecord, box: Box | None, cell_m: float, sparse: bool, path: Path) -> str:
    """Write distances on a lattice as a numpy archive; return what was written.

    Raises:
        ToolError: the grid is too large, there is nothing to fill, or regions are too far away.
        OSError: the file cannot be written.
    """
    filled = box if box is not None else evidence_bounds(record)
    if filled is None:
        raise ToolError("no ray has shown anything of this map: there is no box to fill")
    view = open_view(record)
    grid = _sparse(view, record, box, cell_m=cell_m) if sparse else _dense(view, filled, cell_m)
    with replacing(path) as stream:
        np.savez(stream, epoch=record.epoch, cell_m=cell_m, **grid)
        size = stream.tell()
    shape = " x ".join(str(count) for count in grid["sdf"].shape)
    return f"{size:,} bytes, distances {shape}"


def _dense(view: MapView, box: Box, cell_m: float) -> Arrays:
    """Return all lattice points within a box."""
    corners = list(zip(box[0].tolist(), box[1].tolist(), strict=True))
    sides = [(high - low) / cell_m for low, high in corners]
    if math.prod(side + 1 for side in sides) > MAX_CELLS:  # at most this many points
        sizes = " x ".join(f"{side:.6g}" for side in sides)
        raise _too_many(sizes, math.prod(sides), "--crop, --sparse")
    low = [math.ceil(low / cell_m - _ROUNDING) for low, _ in corners]
    last = [math.floor(high / cell_m + _ROUNDING) for _, high in corners]
    shape = tuple(max(end - start + 1, 0) for start, end in zip(low, last, strict=True))
    first = np.array(low, np.float64)

    def positions(numbers: Longs) -> Doubles:
        cells = np.stack(np.unravel_index(numbers, shape), axis=1)
        return np.asarray((first + cells) * cell_m)

    return {**_filled(view, shape, positions), "origin_m": first * cell_m}


def _sparse(view: MapView, record: MapRecord, box: Box | None, cell_m: float) -> Arrays:
    """Return the blocks with a lattice point within 3 cells of a voxel in which a ray ended."""
    indices = _blocks_near_surface(record, box, cell_m)
    count = len(indices) * BLOCK_CELLS**3
    if count > MAX_CELLS:
        raise _too_many(f"{len(indices):,} blocks", count, "--crop")
    if np.abs(indices).max(initial=0) > np.iinfo(np.int32).max:
        raise ToolError("its regions lie too far from the origin for --sparse: use --crop")

    def positions(numbers: Longs) -> Doubles:
        block, inner = np.divmod(numbers, BLOCK_CELLS**3)
        inside = np.stack(np.unravel_index(inner, (BLOCK_CELLS,) * 3), axis=1)
        return np.asarray((indices[block] * BLOCK_CELLS + inside) * cell_m)

    grid = _filled(view, (len(indices), *(BLOCK_CELLS,) * 3), positions)
    return {**grid, "indices": indices.astype(np.int32)}


def _filled(view: MapView, shape: tuple[int, ...], positions: Positions) -> Arrays:
    """Return distances and statuses of lattice points, numbered in an array's order."""
    count = math.prod(shape)
    sdf, status = np.empty(count, np.float32), np.empty(count, np.uint8)
    with progress("evaluating", 1.0) as report:
        for first in range(0, count, _POINTS_AT_ONCE):
            last = min(first + _POINTS_AT_ONCE, count)
            answer = view.query(positions(np.arange(first, last)))
            sdf[first:last], status[first:last] = answer.sdf, answer.status
            report(last / count, f"{last:,} points")
    return {"sdf": sdf.reshape(shape), "status": status.reshape(shape)}


def _blocks_near_surface(record: MapRecord, box: Box | None, cell_m: float) -> Longs:
    """Return indices [B, 3], in order, each once."""
    middles = surface_voxels(record)
    if box is not None:
        middles = middles[((middles >= box[0]) & (middles <= box[1])).all(axis=1)]
    reach = record.settings.leaf_m / 2 + BAND_CELLS * cell_m
    first = np.floor(np.ceil((middles - reach) / cell_m) / BLOCK_CELLS).astype(np.int64)
    last = np.floor(np.floor((middles + reach) / cell_m) / BLOCK_CELLS).astype(np.int64)
    return np.unique(cells_of_boxes(first, last)[0], axis=0)


def _too_many(what: str, count: float, remedies: str) -> ToolError:
    return ToolError(
        f"the grid would have {what} = {count:.3g} points, more than {MAX_CELLS:,}: "
        f"use {remedies} or a larger --cell"
    )
