"""Checks of a map file beyond those that every reading makes."""

import numpy as np
from triquad_format.mapfile.reader import MapFile
from triquad_format.records import morton
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import MapRecord
from triquad_map.reference.evaluator import MapEvaluator

from triquad_tools.console.command import ToolError

_READER_CHECKS = (
    "records and checksums",
    "parts against manifest",
    "versions and metadata",
    "shapes, codes and values",
)
_PROBES = 10_000


class FailedCheckError(ToolError):
    """A check that a map file fails."""


def verify(file: MapFile) -> tuple[str, ...]:
    """Return what was checked of a file that has been read as ``file``.

    Raises:
        FailedCheckError: a check fails.
    """
    checks = [*_READER_CHECKS, _field(file.record)]
    return tuple(filter(None, checks))


def _field(record: MapRecord) -> str:
    """Check that the field is finite at block centres of the evidence."""
    centres = []
    for region in record.regions:
        codes = region.evidence.codes[:: len(region.evidence.codes) // _PROBES + 1]
        leaves = (morton.decode(codes, 3) + 0.5) * BLOCK_VOXELS
        offset = leaves * record.settings.leaf_m - record.settings.region_side_m / 2
        centres.append(offset + record.settings.region_centre(region.index))
    if not centres:
        return ""
    points = np.concatenate(centres)
    with np.errstate(all="ignore"):  # an overflow is what this checks for
        answer = MapEvaluator(record).query(points)
    if not np.isfinite(answer.sdf).all():
        first = points[int(np.argmin(np.isfinite(answer.sdf)))]
        raise FailedCheckError(f"the field at {first.tolist()} is not finite")
    return f"field finite at {len(points)} points"
