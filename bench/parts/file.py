"""Map files: how small, how true, how quickly opened."""

import argparse
import dataclasses
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import BinaryIO

from triquad_client import OfflineMap
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import MapFileInfo, write_map
from triquad_format.records.region import MapRecord
from triquad_map.preview import previews_of
from triquad_server.epochs.epoch import Epoch
from triquad_tools.mapfiles.quantise import field_change, quantise

from bench.figures import Figure, seconds
from bench.parts.offline import measure_offline
from bench.parts.store import measure_store
from bench.street import bench_street, settled_mapper
from bench.street_scores import DrivenStreet

_LARGE_BYTES = 100_000_000
_INTEGER_ERROR_M = 0.0015  # gives most features one byte
_SEED = 2  # of the points at which the file is compared with the live map

_OPEN = """
import sys, time
from triquad_format.mapfile.reader import StoredMap
started = time.perf_counter()
with StoredMap.open(sys.argv[1]) as stored:
    stored.box((9.0, -1.0, -0.5), (11.0, 1.0, 1.5))
print(time.perf_counter() - started)
"""


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of the street's map as a file, and of a larger one's checkpoints."""
    made = bench_street(options.seed)
    epoch = settled_mapper("the street", made.scans).publish()
    record = epoch.record()
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        folder = Path(name)
        figures = _sizes(epoch, record, made, folder=folder)
        figures += _opening(record, folder)
        figures += measure_offline(made, epoch, folder / "fp16.triquad")
    return figures + measure_store(made)


def _sizes(epoch: Epoch, record: MapRecord, made: DrivenStreet, folder: Path) -> list[Figure]:
    plain = written(epoch, record, folder / "fp16.triquad")
    stored = read_map(folder / "fp16.triquad")
    eighth, tight = quantise(stored, _INTEGER_ERROR_M), quantise(stored, 0.002)
    small = written(epoch, eighth.record, folder / "int8.triquad")
    least = written(epoch, tight.record, folder / "2mm.triquad")
    live = field_change(record, stored, _SEED)
    count = epoch.parameters
    scores = [_f_score(one, made) for one in (stored, tight.record)]
    return [
        Figure("parameters of the map", count / 1e6, "M"),
        Figure("fp16 file", plain.bytes / 1e6, "MB", at_most=4),
        Figure("fp16, everything included", plain.bytes / count, "bytes/parameter", at_most=1.9),
        Figure("fp16 against the live map, 99 %", 1e3 * live.quantile_m, "mm", at_most=1),
        Figure("int8 file", small.bytes / 1e6, "MB"),
        Figure("int8, everything included", small.bytes / count, "bytes/parameter", at_most=1.0),
        Figure("int8 against fp16, 99 %", 1e3 * eighth.change.quantile_m, "mm", at_most=2),
        Figure("file within 2 mm", least.bytes / 1e6, "MB", at_most=2),
        Figure("within 2 mm, everything included", least.bytes / count, "bytes/parameter"),
        Figure("the same against fp16, 99 %", 1e3 * tight.change.quantile_m, "mm", at_most=2),
        Figure("the same, largest of all points", 1e3 * tight.change.largest_m, "mm"),
        Figure("F-score, fp16", scores[0], "%"),
        Figure("F-score within 2 mm, change", abs(scores[1] - scores[0]), "points", at_most=0.2),
    ]


def written(epoch: Epoch, record: MapRecord, path: Path | BinaryIO) -> MapFileInfo:
    """Write a map as a server does, with its previews."""
    return write_map(record, path, previews=previews_of(record, epoch))


def _f_score(record: MapRecord, made: DrivenStreet) -> float:
    with OfflineMap(record) as opened:
        return 100 * made.mesh_scores(opened.mesh(made.drive.scene.box)).f_score


def _opening(record: MapRecord, folder: Path) -> list[Figure]:
    """Return figures of opening a large file: copies of the street's region, side by side."""
    path = folder / "large.triquad"
    first = record.regions[0]
    bytes_each = write_map(record, folder / "one.triquad").bytes
    copies = -(-_LARGE_BYTES // bytes_each)
    row = tuple(dataclasses.replace(first, index=(number, 0, 0)) for number in range(copies))
    size = write_map(dataclasses.replace(record, regions=row), path).bytes
    started = time.perf_counter()
    answered = subprocess.run(
        [sys.executable, "-c", _OPEN, str(path)], stdout=subprocess.PIPE, text=True, check=True
    )
    process_s = time.perf_counter() - started
    read_s = seconds(lambda: read_map(path))
    return [
        Figure("large file", size / 1e6, "MB", at_least=100),
        Figure("large file, opened until the first answer", float(answered.stdout), "s", at_most=1),
        Figure("the same with starting Python", process_s, "s"),
        Figure("large file, read whole and checked", read_s, "s"),
    ]
