"""Recorded drives: the scans that are mapped, and those that are withheld to score the map."""

from dataclasses import dataclass
from pathlib import Path

from triquad_tools.recordings.cloud import points_in_range
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.sensors.sweep import PosedScan

_SKIP_EVERY = 7
_RANGE_MIN_M = 2.0  # nearer is the vehicle's own body


@dataclass(frozen=True)
class RecordedScans:
    """Scans of a recorded drive: those to map, and those to withhold."""

    mapped: tuple[PosedScan, ...]
    withheld: tuple[PosedScan, ...]


def recorded_scans(path: Path, scans: int | None = None) -> RecordedScans:
    """Return the scans of a folder (the first ``scans`` of them), every 7th apart.

    Raises:
        ToolError: the folder cannot be read.
    """
    folder = read_cloud_folder(path)
    mapped: list[PosedScan] = []
    withheld: list[PosedScan] = []
    indices = range(len(folder))[:scans]
    for index, whole in zip(indices, folder.read(indices), strict=True):
        near = points_in_range(whole.points, _RANGE_MIN_M)
        scan = PosedScan(near, whole.world_from_sensor)
        (withheld if index % _SKIP_EVERY == _SKIP_EVERY - 1 else mapped).append(scan)
    return RecordedScans(tuple(mapped), tuple(withheld))
