"""Which faces of a mesh stand for surface that rays have seen.

The field crosses zero elsewhere, too, where no ray taught it anything, and goes on beyond the edge
of what was seen.
"""

from triquad_format.records.arrays import Bools, Doubles
from triquad_format.records.status import Status

from triquad_map.view import MeshedView

_FINE = 0.5
"""Faces of larger cells, in voxels, stand for too much to end within a voxel."""


def are_seen(view: MeshedView, middles: Doubles, cell_m: float, reach_m: float) -> Bools:
    """Whether faces [F] lie where rays ended.

    Args:
        view: the map.
        middles: [F, 3] of the faces, metres, map frame.
        cell_m: side of the cells in which they lie.
        reach_m: how far beside a voxel in which rays ended the middle may be.
    """
    if cell_m <= _FINE * view.voxel_m:
        return view.near_ends(middles, reach_m)
    seen: Bools = view.status(middles, reach_m) == Status.SURFACE
    return seen
