"""True surface points, as people have them."""

from pathlib import Path

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.console.command import ToolError
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.recordings.cloud import merged, world_points
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.recordings.recording import ReadingOptions


def read_reference(path: Path, voxel_m: float, range_min_m: float = 0.0) -> Doubles:
    """Return the points [N, 3] of a cloud, or of all scans of a folder in the world frame.

    Args:
        path: a ``.ply`` file, or a folder of scans, which are thinned to ``voxel_m``.
        voxel_m: metres.
        range_min_m: nearer points of scans are left out.

    Raises:
        ToolError: there are no points.
    """
    if path.is_dir():
        # Points are what counts, from wherever they were seen.
        folder = read_cloud_folder(path, ReadingOptions(ray_origin=(0.0, 0.0, 0.0)))
        clouds = (world_points(scan, range_min_m) for scan in folder.read(range(len(folder))))
        points = merged(clouds, voxel_m)
    else:
        points = np.asarray(read_mesh(path).vertices, np.float64)
    if not len(points):
        raise ToolError(f"{path}: holds no points")
    return points
