"""Evidence that takes in scans, as the server has it do, without a field."""

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_map.evidence.carving import CLEAR_SHORT, FREE_SHORT, Reach
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting

SIDE = 256
SENSOR = np.array([20.3, 128.4, 128.6])


class Watched:
    """Evidence that takes in scans, as the server does."""

    def __init__(self) -> None:
        self.evidence = LiveEvidence(SIDE)
        self.scans = 0

    def scan(self, ends: Doubles, sensor: Doubles = SENSOR) -> int:
        """Take in rays that end at ``ends`` [N, 3]; returns how many voxels lost surface."""
        self.scans += 1
        sighting = Sighting(sensor, 0.2, self.scans, scan=self.scans)
        rows = self.evidence.record_ends(ends, sighting)
        search = self.evidence.outdated_normals(rows, sighting.unlearnt_since)
        search.find(0, len(search.rows))
        passed = self.evidence.carve(sensor, ends, Reach(FREE_SHORT, CLEAR_SHORT, self.scans))
        search.finish()
        return len(self.evidence.believe(rows, passed).removed)

    def believed(self, voxels: Doubles) -> float:
        """Share of ``voxels`` [N, 3] that are surface."""
        return float(self.evidence.freeze().ended_in(np.floor(voxels).astype(np.int64)).mean())
