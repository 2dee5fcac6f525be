"""The golden map files: one that can be trained on, and one that cannot.

``python -m support.files.golden`` in the folder of the tests writes them again: only where the
format changes, and then in one commit with ``docs/map-file.md``.
"""

import dataclasses
from pathlib import Path

from support.maps.map_records import SMALL, random_record, with_rays, with_support
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapProgress, MapRecord

FOLDER = Path(__file__).parents[2] / "golden"
TRAINED, PLAIN = "map_v1.triquad", "map_v1_plain.triquad"
PRODUCER = "triquad 0.1.0"
ZSTD = (1, 5, 7)
"""The release of zstd that compressed the files: others may give other bytes."""

_STAMP_NS = 1_700_000_000 * 10**9


def golden_records() -> dict[str, MapRecord]:
    """The record of each file."""
    indices = ((0, 0, 0), (-1, 2, 0))
    record = random_record(2024, indices=indices, points=12, name="golden", epoch=42)
    record = with_rays(with_support(record), 40)
    record = dataclasses.replace(record, progress=MapProgress(60, 116_000_000, 0.25))
    wide = dataclasses.replace(SMALL, depth=9)
    plain = random_record(2025, settings=wide, training=False, name="golden", epoch=44)
    return {
        TRAINED: record,
        PLAIN: with_support(plain),
    }


def write_golden(folder: Path) -> None:
    """Write the files; none has a preview."""
    folder.mkdir(exist_ok=True)
    for name, record in golden_records().items():
        write_map(record, folder / name, stamp_ns=_STAMP_NS)


if __name__ == "__main__":
    write_golden(FOLDER)
