"""The points of scans that the paper uses, and scans that a map takes in or refuses."""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray
from triquad_server.errors import ScanRefusedError
from triquad_server.mapping.mapper import Mapper

from triquad_tools.console.command import print_remark
from triquad_tools.console.progress import progress
from triquad_tools.sensors.sweep import PosedScan

_RANGE_M = (1.5, 50.0)


def in_range(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points [N, 3], sensor frame, of the ranges that the paper uses."""
    ranges = np.linalg.norm(points, axis=1)
    chosen: NDArray[np.float64] = points[(ranges >= _RANGE_M[0]) & (ranges <= _RANGE_M[1])]
    return chosen


def taken(mapper: Mapper, scans: Iterable[PosedScan], total: int) -> Iterator[int]:
    """Take in ``total`` scans, and yield how many are; those that the map refuses are told."""
    refused, why = 0, ""
    with progress("mapping", total) as report:
        for number, scan in enumerate(scans, start=1):
            try:
                mapper.ingest(np.asarray(scan.points, np.float32), scan.world_from_sensor)
            except ScanRefusedError as error:
                refused, why = refused + 1, str(error)
            report(number, f"{number} of {total} scans")
            yield number
    if refused:
        print_remark(f"{refused} of {total} scans were refused, the last since {why}")
