"""A picture of what a map file holds: where surface and where only free space was seen."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_format.records import morton
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import MapRecord
from triquad_format.records.seen_space import owned_evidence
from triquad_map.height_scale import HeightScale

from triquad_tools.plots.plan import (
    FREE,
    HEIGHTS,
    Layer,
    PlanGrid,
    Scale,
    draw_layers,
    draw_values,
    sheet,
)


def draw_map(title: str, record: MapRecord, path: Path) -> None:
    """Draw a plan of a map's coverage.

    Raises:
        OSError: ``path`` cannot be written.
    """
    surface, seen = seen_columns(record, surface_only=True), seen_columns(record)
    grid = PlanGrid.around(seen.middles, record.settings.leaf_m)
    heights = HeightScale.around(surface.tops)
    scale = Scale("height of the topmost surface in m", HEIGHTS, heights.low_m, heights.high_m)
    with sheet(path, title, grid, ["Coverage"]) as (axes,):
        draw_layers(axes, [Layer("only free space was seen", FREE, grid.marked(seen.middles))])
        draw_values(axes, grid.statistic(surface.middles, surface.tops, "max"), scale)


@dataclass(frozen=True)
class Columns:
    """Upright columns of voxels, each within one block of evidence."""

    middles: Doubles  # [N, 2] metres, map frame
    tops: Doubles  # [N] height of the middle of the highest voxel, metres


def seen_columns(record: MapRecord, surface_only: bool = False) -> Columns:
    """Return the columns where rays ended or, unless ``surface_only``, which they passed."""
    settings, parts = record.settings, [np.empty((0, 3))]
    for region in record.regions:
        evidence = owned_evidence(settings, region)
        # A byte holds one column.
        octets = evidence.surface if surface_only else evidence.surface | evidence.free
        rows, numbers = np.nonzero(octets)
        x, y = np.divmod(numbers, BLOCK_VOXELS)
        top = np.log2(octets[rows, numbers], dtype=np.float32).astype(np.int64)
        voxels = morton.decode(evidence.codes, 3)[rows] * BLOCK_VOXELS + np.stack([x, y, top], 1)
        parts.append(settings.region_corner(region.index) + (voxels + 0.5) * settings.leaf_m)
    middles = np.concatenate(parts)
    return Columns(middles[:, :2], middles[:, 2])
