"""The drive along a random street that the demonstration makes and ``triquad-eval`` remakes."""

from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

STEP_M = 1.0  # between scans


def street_drive(seed: int, scans: int, step_m: float = STEP_M) -> SimulatedDrive:
    """A drive of some scans along street ``seed``; the same arguments give the same scans."""
    scene = street(seed)
    return SimulatedDrive(scene, Lidar(), drive(scene, scans, step_m), seed)
