"""Other mappers on the same scans, where they are installed."""

from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np
from triquad_client import Mesh

from triquad_tools.console.progress import progress
from triquad_tools.paper.intake import in_range
from triquad_tools.sensors.sweep import PosedScan, moved

VOXEL_M, TRUNCATION_M = 0.1, 0.3  # as in 3QFP, section IV


def has_vdbfusion() -> bool:
    """Return whether VDBFusion can be run; its wheels, up to Python 3.10, crash with numpy 2."""
    return find_spec("vdbfusion") is not None and np.__version__.startswith("1.")


def vdbfusion_mesh(scans: Sequence[PosedScan]) -> Mesh:
    """Return the mesh of VDBFusion (Vizzo et al., Sensors 2022) of scans."""
    import vdbfusion

    volume = vdbfusion.VDBVolume(VOXEL_M, TRUNCATION_M, space_carving=False)
    with progress("VDBFusion", len(scans)) as report:
        for number, scan in enumerate(scans):
            points = in_range(np.asarray(scan.points, np.float64))
            pose = np.asarray(scan.world_from_sensor, np.float64)
            volume.integrate(moved(points, pose), pose)
            report(number, f"{number} of {len(scans)} scans")
    vertices, faces = volume.extract_triangle_mesh(fill_holes=False, min_weight=0.0)
    return Mesh(vertices, faces.astype(np.int32), None)
