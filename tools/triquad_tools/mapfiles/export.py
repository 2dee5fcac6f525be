"""A map as a file for other programs: a mesh, or distances on a lattice."""

from pathlib import Path

import numpy as np
from triquad_format.mapfile.files import replacing
from triquad_format.records.region import MapRecord

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.grid import (
    DenseGrid,
    SparseGrid,
    dense_grid,
    evidence_bounds,
    open_record,
    sparse_grid,
)
from triquad_tools.mapfiles.mesh import surface_mesh
from triquad_tools.mapfiles.source import Box

MARGIN_CELLS = 16
"""A map that is exported within a box is needed so far around it."""


def export_mesh(record: MapRecord, box: Box | None, cell_m: float, path: Path) -> str:
    """Write the mesh of a map; returns what was written.

    Raises:
        ToolError: the mesh is too large, or its regions are too far away.
        OSError: the file cannot be written.
    """
    mesh = surface_mesh(record, box, cell_m)
    packed = mesh.file_bytes(path.suffix)
    with replacing(path) as stream:
        stream.write(packed)
    return f"{len(packed):,} bytes, {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"


def export_grid(record: MapRecord, box: Box | None, cell_m: float, sparse: bool, path: Path) -> str:
    """Write distances on a lattice as a numpy archive; errors as :func:`export_mesh`."""
    filled = box if box is not None else evidence_bounds(record)
    if filled is None:
        raise ToolError("no ray has shown anything of this map: there is no box to fill")
    query = open_record(record).query
    grid: DenseGrid | SparseGrid
    with progress("evaluating", 1.0) as report:
        if sparse:
            grid = sparse_grid(query, record, box, cell_m, report)
        else:
            grid = dense_grid(query, filled, cell_m, report)
    with replacing(path) as stream:
        np.savez(stream, epoch=record.epoch, **vars(grid))
        size = stream.tell()
    shape = " x ".join(str(count) for count in grid.sdf.shape)
    return f"{size:,} bytes, distances {shape}"
