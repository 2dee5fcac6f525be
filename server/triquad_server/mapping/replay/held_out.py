"""Rays that a region is never trained on, used to judge its field."""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import replay_rays
from triquad_format.records.arrays import Bools, Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.kernel import inner_kernel, kernel

from triquad_server.mapping.replay.ray_table import END


def ends_in_steps(rows: Floats, settings: FieldSettings) -> NDArray[np.int64]:
    """Return where the rays end [N, 3], given by the ``rows`` [N, COLUMNS] of their table, as in
    :class:`triquad_format.records.replay_rays.ReplayRays`.
    """
    leaves = rows[:, END : END + 3].astype(np.float64) / settings.leaf_m + (1 << settings.depth)
    return np.floor(leaves * replay_rays.STEPS).astype(np.int64)


def ray_keys(rows: Floats, settings: FieldSettings) -> Longs:
    """Return a number for each ray that identifies where it ends."""
    return replay_rays.ray_keys(ends_in_steps(rows, settings))


@kernel(inline="always")
def end_in_steps(row: Floats, leaf_m: float, corner: float) -> tuple[int, int, int]:
    """Return :func:`ends_in_steps` of one ray; the cube's ``corner`` is that many leaves away."""
    return (
        np.int64(np.floor((np.float64(row[END]) / leaf_m + corner) * replay_rays.STEPS)),
        np.int64(np.floor((np.float64(row[END + 1]) / leaf_m + corner) * replay_rays.STEPS)),
        np.int64(np.floor((np.float64(row[END + 2]) / leaf_m + corner) * replay_rays.STEPS)),
    )


@inner_kernel()
def is_held_out(x: int, y: int, z: int) -> bool:
    """Return :func:`triquad_format.records.replay_rays.are_held_out` of one ray."""
    key = np.uint64(0)
    for step in (x, y, z):
        key = key << np.uint64(replay_rays.AXIS_BITS) | np.uint64(step & replay_rays.AXIS_MASK)
    held: bool = (key * replay_rays.MIXED) >> np.uint64(replay_rays.MIXED_SHIFT) == 0
    return held


@kernel()
def _held_out(rows: Floats, leaf_m: float, corner: float) -> Bools:
    held = np.empty(len(rows), np.bool_)
    for i in range(len(rows)):
        x, y, z = end_in_steps(rows[i], leaf_m, corner)
        held[i] = is_held_out(x, y, z)
    return held


def are_held_out(rows: Floats, settings: FieldSettings) -> Bools:
    """Return which rays are held out."""
    return _held_out(rows, settings.leaf_m, float(1 << settings.depth))
