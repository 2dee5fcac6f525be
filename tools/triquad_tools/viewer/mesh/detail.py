"""How finely the parts of a map are drawn: as finely as the screen can show, and no more."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles, Ints


@dataclass(frozen=True)
class Viewpoint:
    """From where somebody looks."""

    position: Doubles  # [3] metres, map frame
    radians_per_pixel: float


def wanted_levels(
    corners: Doubles, side_m: float, cells_m: Doubles, *, viewpoint: Viewpoint, pixels: float
) -> Ints:
    """Which level of detail [T] each tile deserves: the coarsest of cells of so many pixels.

    Tiles above each other have one level, the finest of theirs: where the ground lies in the side
    between two of them, as at z = 0, meshes of two levels would leave holes all over it.

    Args:
        corners: [T, 3] least corners of the tiles, metres, map frame.
        side_m: of the tiles.
        cells_m: [L] sides of the cells of the levels, the finest first.
        viewpoint: from where they are seen.
        pixels: that a cell may cover on the screen, seen at right angles.
    """
    nearest = np.clip(viewpoint.position, corners, corners + side_m)
    distance_m = np.linalg.norm(nearest - viewpoint.position, axis=1)
    allowed_m = distance_m * viewpoint.radians_per_pixel * pixels
    coarsest = np.searchsorted(cells_m, allowed_m, side="right") - 1
    _, columns = np.unique(corners[:, :2], axis=0, return_inverse=True)
    columns = columns.reshape(-1)
    finest = np.full(len(corners), len(cells_m) - 1, np.int32)
    np.minimum.at(finest, columns, np.maximum(coarsest, 0).astype(np.int32))
    return np.asarray(finest[columns], np.int32)
