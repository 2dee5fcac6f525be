"""Scans that a map takes in, and those that it refuses."""

from collections.abc import Iterator, Sequence

import numpy as np
from triquad_server.errors import ScanRefusedError
from triquad_server.mapping.mapper import Mapper

from triquad_tools.console.command import print_remark
from triquad_tools.console.progress import progress
from triquad_tools.sensors.sweep import PosedScan


def taken(mapper: Mapper, scans: Sequence[PosedScan]) -> Iterator[int]:
    """Take in scans, and yield how many are; those that the map refuses are left out, and told."""
    refused, why = 0, ""
    with progress("mapping", len(scans)) as report:
        for number, scan in enumerate(scans, start=1):
            try:
                mapper.ingest(np.asarray(scan.points, np.float32), scan.world_from_sensor)
            except ScanRefusedError as error:
                refused, why = refused + 1, str(error)
            report(number, f"{number} of {len(scans)} scans")
            yield number
    if refused:
        print_remark(f"{refused} of {len(scans)} scans were refused, the last since {why}")
