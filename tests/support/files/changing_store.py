"""A store whose map changes: a ground on which a box of 1.5 m stands here, there, or nowhere."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from support.maps.exact_maps import Height, exact_map, flat
from triquad_format.mapfile.writer import write_map

START_NS = 1_769_860_800 * 10**9  # 2026-01-31T12:00:00Z
HOUR_NS = 3600 * 10**9
EMPTY = flat(0.1)


def box_at(x_m: float, y_m: float) -> Height:
    """A ground with a box."""

    def height(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        inside = np.maximum(np.abs(x - x_m), np.abs(y - y_m)) < 1.5
        return np.where(inside, 1.5, 0.1)

    return height


def write_checkpoint(folder: Path, epoch: int, height: Height) -> Path:
    """A map file as a checkpoint, written ``epoch`` hours after the start; its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"epoch-{epoch:09d}.triquad"
    write_map(exact_map(height, epoch), path, stamp_ns=START_NS + epoch * HOUR_NS)
    return path
