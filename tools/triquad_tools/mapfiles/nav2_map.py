"""A map from above for ``map_server`` of Nav2 and of ROS 1: a YAML file and a PGM image.

https://docs.nav2.org/configuration/packages/configuring-map-server.html
"""

import json
from pathlib import Path

import numpy as np
from triquad_client import OfflineMap
from triquad_format.mapfile.files import replacing
from triquad_format.records.arrays import Bytes

from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.grid_file import checked_shape, surface_box
from triquad_tools.mapfiles.occupancy import HEIGHT_M, STEP_M, Occupancy, occupancy
from triquad_tools.mapfiles.source import Box, NothingLeftError

_CELL_LEAVES = 0.5
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205  # pixels, as map_saver writes them
_OCCUPIED_THRESH, _FREE_THRESH = 0.65, 0.196  # of (255 - pixel) / 255; a larger one takes 205 in


def image_path(path: Path) -> Path:
    """Return the name of the image that belongs to a YAML file."""
    return path.with_suffix(".pgm")


def write_nav2_map(opened: OfflineMap, path: Path, box: Box | None, cell_m: float | None) -> str:
    """Write where a robot can drive, as :func:`occupancy` tells it.

    Args:
        opened: the map.
        path: the YAML file to write; the image lies in the same folder.
        box: what is shown, of which only surface in it counts; ``None``: all.
        cell_m: side of a cell, which is a pixel; ``None``: half a leaf.

    Returns:
        What was written, in words.

    Raises:
        NothingLeftError: no surface was seen in the box.
        ToolError: there are too many cells.
        OSError: a file cannot be written.
    """
    shown = surface_box(opened, path) if box is None else box
    side_m = _CELL_LEAVES * opened.leaf_m if cell_m is None else cell_m
    shape = checked_shape(path, shown, side_m, layers=1)
    checked_shape(path, shown, opened.leaf_m, layers=1)  # the ground is sought leaf by leaf
    with progress("looking for the ground", 1.0) as report:
        found = occupancy(opened, shape, shown, report)
    if not (found.occupied | found.free).any():
        raise NothingLeftError(f"{path} is not written: no ground was seen in the box of --crop")
    image = image_path(path)
    with replacing(path) as stream, replacing(image) as pixels:
        pixels.write(_image(found))
        stream.write(_description(found, image.name).encode())
    shares = f"{found.occupied.mean():.1%} occupied, {found.free.mean():.1%} free"
    return (
        f"{shape.counts[0]} x {shape.counts[1]} cells of {side_m:g} m in {image}, {shares}, for a "
        f"robot {HEIGHT_M:g} m high that drives over {STEP_M:g} m"
    )


def _image(found: Occupancy) -> bytes:
    """Return a PGM of cells; its first row is of the greatest y."""
    values = np.where(found.occupied, _OCCUPIED, np.where(found.free, _FREE, _UNKNOWN))
    pixels: Bytes = values.astype(np.uint8).T[::-1]
    rows, columns = pixels.shape
    header = f"P5\n{columns} {rows}\n255\n".encode()
    return header + pixels.tobytes()


def _description(found: Occupancy, image: str) -> str:
    """Return the YAML file; the origin is the least corner of the pixel at the lower left."""
    x, y, _ = found.shape.corner.tolist()
    return (
        f"image: {json.dumps(image)}\n"
        "mode: trinary\n"
        f"resolution: {found.shape.cell_m!r}\n"
        f"origin: [{x:.6f}, {y:.6f}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {_OCCUPIED_THRESH}\n"
        f"free_thresh: {_FREE_THRESH}\n"
    )
