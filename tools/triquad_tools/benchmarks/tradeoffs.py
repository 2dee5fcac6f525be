"""``triquad-bench tradeoffs``: how good a map is by its time, its bytes and its scans.

All of it is one drive along the exact street; every mesh is scored against all that the lidar
hit in the whole of it.
"""

import io
import math
import time

from triquad_client import OfflineMap
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.preview import previews_of
from triquad_server.settings import Settings

from triquad_tools.benchmarks.figures import CurvePoint, Figure
from triquad_tools.benchmarks.street import BenchStreet, settled_mapper
from triquad_tools.benchmarks.tradeoff_sheet import ACCURACY, BYTES, F_SCORE, SPACING, TIME
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.quantise import quantise

_TRAINED_S = (1.0, 2.0, 4.0, 8.0, 16.0, math.inf)  # of all cores; to the end, at last
_ERRORS_M = (0.001, 0.002, 0.005, 0.01, 0.02)  # of triquad-pack --max-error
_EVERY = (1, 2, 5, 10)  # scans


def measure_tradeoffs(made: BenchStreet) -> list[Figure]:
    """Figures along three curves, each with its place on them."""
    figures, settled = _by_time(made)
    figures += _by_bytes(settled, made)
    for every in _EVERY:
        if every == 1:
            epoch = settled
        else:
            epoch = settled_mapper(f"one scan of {every}", made.scans[::every]).publish()
        figures += _scores(epoch.record(), made, curve=SPACING, cost=every)
    return figures


def _by_time(made: BenchStreet) -> tuple[list[Figure], Epoch]:
    """Scores after so many seconds of taking scans in and training, of all cores together.

    The epoch is that of the settled map, of all scans.
    """
    settings = Settings()
    mapper = Mapper("bench", settings, "cpu")
    began_s = time.process_time()
    for scan in made.scans:
        mapper.ingest(scan.points, scan.world_from_sensor)
    taken_s = time.process_time() - began_s
    figures: list[Figure] = []
    trained_s = 0.0
    with progress("mapping by time", len(_TRAINED_S)) as report:
        for number, budget_s in enumerate(_TRAINED_S):
            if mapper.settled:
                break
            began_s = time.process_time() - trained_s
            while trained_s < budget_s and not mapper.settled:
                mapper.train()
                trained_s = time.process_time() - began_s
            cost = taken_s + trained_s
            epoch = mapper.publish()
            figures += _scores(epoch.record(), made, curve=TIME, cost=cost)
            report(number + 1, f"{cost:.1f} s")
    return figures, epoch


def _by_bytes(epoch: Epoch, made: BenchStreet) -> list[Figure]:
    """Scores of a map's file, as it is and packed within errors."""
    plain = io.BytesIO()
    size = _written(epoch.record(), epoch, plain)
    plain.seek(0)
    stored = read_map(plain)
    figures = _scores(stored, made, curve=BYTES, cost=size)
    with progress("packing", len(_ERRORS_M)) as report:
        for number, error_m in enumerate(_ERRORS_M):
            packed = quantise(stored, error_m).record
            size = _written(packed, epoch, io.BytesIO())
            figures += _scores(packed, made, curve=BYTES, cost=size)
            report(number + 1, f"within {1e3 * error_m:g} mm")
    return figures


def _written(record: MapRecord, epoch: Epoch, file: io.BytesIO) -> int:
    """Write a map as a server does, with its previews; returns how many bytes that are."""
    return write_map(record, file, previews=previews_of(record, distances=epoch.distances)).bytes


def _scores(record: MapRecord, made: BenchStreet, *, curve: str, cost: float) -> list[Figure]:
    with OfflineMap(record) as opened:
        scores = made.mesh_scores(opened.mesh(made.drive.scene.box))
    where = {
        TIME: f"after {cost:.1f} processor seconds",
        BYTES: f"in {cost / 1e6:.2f} MB",
        SPACING: f"of one scan in {cost:g}",
    }[curve]
    return [
        Figure(f"{measure} {where}", value, unit, point=CurvePoint(curve, measure, cost))
        for measure, value, unit in (
            (F_SCORE, 100 * scores.f_score, "%"),
            (ACCURACY, 100 * scores.accuracy_m, "cm"),
        )
    ]
