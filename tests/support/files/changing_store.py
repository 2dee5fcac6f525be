"""A store whose map changes: a ground on which a box of 1.5 m stands here, there, or nowhere."""

from pathlib import Path

from support.files.checkpoint_folder import HOUR_NS, START_NS
from support.maps.exact_maps import Height, exact_map, flat, table
from triquad_format.mapfile.writer import write_map

EMPTY = flat(0.1)


def box_at(x_m: float, y_m: float) -> Height:
    """A ground with a box."""
    return table(0.1, 1.5, 3.0, (x_m, y_m))


def write_checkpoint(folder: Path, epoch: int, height: Height) -> Path:
    """A map file as a checkpoint, written ``epoch`` hours after the start; its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"epoch-{epoch:09d}.triquad"
    write_map(exact_map(height, epoch), path, stamp_ns=START_NS + epoch * HOUR_NS)
    return path
