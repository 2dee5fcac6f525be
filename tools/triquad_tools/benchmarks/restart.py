"""``triquad-bench`` of a restart: what a checkpoint keeps of what was learnt, in how many bytes.

A street is learnt, and then another part of it from which the first is out of sight: by the map
that stayed in memory, and by the one that was restored from a checkpoint of the first.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_sensors.sweep import PosedScan
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import learn_again, sdf_error_cm, settled_mapper
from triquad_tools.console.progress import progress
from triquad_tools.evaluation.map_scores import DrivenStreet, driven_street
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

_STEP_M = 1.0
_SCANS = 100  # of the place that is learnt first
_BETWEEN = 85  # metres from there to where it goes on
_LATER = 80
_COLUMNS = 1024


def measure_restart(seed: int) -> list[Figure]:
    """Errors of a place that was learnt, after scans elsewhere, with a restart and without."""
    first, later = _two_places(seed)
    stayed = settled_mapper("the first place", first.scans)
    record = stayed.changes_since(None).record
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        path = Path(name) / "checkpoint.triquad"
        size = write_map(record, path).bytes
        restored = Mapper("bench", Settings(), "cpu", read_map(path))
    before = sdf_error_cm(stayed.publish(), first.probes)
    errors = []
    for name, mapper in (("without a restart", stayed), ("after a restart", restored)):
        _learn(name, mapper, later)
        errors.append(sdf_error_cm(mapper.publish(), first.probes))
    without, after = errors
    return [
        Figure("checkpoint with all that training needs", size / 1e6, "MB"),
        Figure("SDF error of a place, settled", before, "cm"),
        Figure(f"the same after {_LATER} scans elsewhere", without, "cm"),
        Figure("the same with a restart before these scans", after, "cm"),
        Figure("with the restart, times without", after / without, "", at_most=1.03),
    ]


def _two_places(seed: int) -> tuple[DrivenStreet, list[PosedScan]]:
    count = _SCANS + _BETWEEN + _LATER
    scene = street(seed, count * _STEP_M)
    poses = drive(scene, count, _STEP_M)
    first, later = (
        SimulatedDrive(scene, Lidar(columns=_COLUMNS), some, seed=seed)
        for some in (poses[:_SCANS], poses[-_LATER:])
    )
    return driven_street(first), list(later)


def _learn(name: str, mapper: Mapper, scans: Sequence[PosedScan]) -> None:
    with progress(f"going on {name}", len(scans) + 1) as report:
        for number, scan in enumerate(scans):
            mapper.ingest(scan.points, scan.world_from_sensor)
            report(number, f"scan {number}")
        learn_again(mapper)
        report(len(scans) + 1, "settled")
