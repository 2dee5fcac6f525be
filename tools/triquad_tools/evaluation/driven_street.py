"""A street that a simulated lidar has been driven through."""

from dataclasses import dataclass

import numpy as np

from triquad_tools.console.progress import progress
from triquad_tools.evaluation.map_scores import StreetProbes, street_probes
from triquad_tools.simulation.lidar import SimulatedDrive, SimulatedScan

_SEED = 0  # of the points that are asked


@dataclass(frozen=True)
class DrivenStreet:
    """A simulated drive, its scans and where its map will be asked."""

    drive: SimulatedDrive
    scans: list[SimulatedScan]
    probes: StreetProbes


def driven_street(drive: SimulatedDrive) -> DrivenStreet:
    """Make all scans of a drive."""
    scans: list[SimulatedScan] = []
    with progress("simulating the drive", len(drive)) as report:
        for scan in drive:
            scans.append(scan)
            report(len(scans), f"{len(scans)} of {len(drive)} scans")
    return DrivenStreet(drive, scans, street_probes(drive, np.random.default_rng(_SEED)))
