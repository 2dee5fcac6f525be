"""``python -m bench.studies.tradeoffs OUT.png``: how good a map is for its time, bytes and scans.

The map is of one drive along an exact street; every mesh is scored against all lidar hits
of the whole drive. It is drawn with VDBFusion 0.1.6, measured on the same scans.
"""

import argparse
import io
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from matplotlib.figure import Figure as Sheet
from matplotlib.ticker import NullFormatter, ScalarFormatter
from triquad_client import OfflineMap
from triquad_format.mapfile.reader import read_map
from triquad_format.records.region import MapRecord
from triquad_server.epochs.epoch import Epoch
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_tools.console.arguments import picture
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.quantise import quantise

from bench.parts.file import written
from bench.street import bench_street, settled_mapper
from bench.street_scores import DrivenStreet

_TRAINED_S = (1.0, 2.0, 4.0, 8.0, 16.0, math.inf)  # of all cores; until settled, at last
_ERRORS_M = (0.001, 0.002, 0.005, 0.01, 0.02)  # of triquad-pack --max-error
_EVERY = (1, 2, 5, 10)  # scans

TIME, BYTES, SPACING = "processor seconds", "file, MB", "one scan in"


@dataclass(frozen=True)
class Scored:
    """The scores of a map at one point of a curve."""

    curve: str
    cost: float
    f_score: float  # percent, at 10 cm
    accuracy_cm: float  # mean error of the mesh where it is below 20 cm


_STREET = 1
_NEIGHBOUR = (
    Scored(TIME, 3.6, f_score=98.56, accuracy_cm=0.72),
    Scored(BYTES, 32.25, f_score=98.56, accuracy_cm=0.72),
    Scored(SPACING, 1, f_score=98.56, accuracy_cm=0.72),
    Scored(SPACING, 2, f_score=97.18, accuracy_cm=0.78),
    Scored(SPACING, 5, f_score=92.59, accuracy_cm=0.89),
    Scored(SPACING, 10, f_score=80.32, accuracy_cm=0.98),
)
"""VDBFusion 0.1.6, voxels of 10 cm, on the scans of the street; its meshes scored as all others."""


def measure_tradeoffs(made: DrivenStreet) -> list[Scored]:
    """Return scores along three curves."""
    scores, settled = _by_time(made)
    scores += _by_bytes(settled, made)
    for every in _EVERY:
        if every == 1:
            epoch = settled
        else:
            epoch = settled_mapper(f"one scan of {every}", made.scans[::every]).publish()
        scores.append(_score(epoch.record(), made, curve=SPACING, cost=every))
    return scores


def draw(scores: Sequence[Scored], path: Path) -> None:
    """Save a picture of the three curves, F-score above and accuracy below."""
    sheet = Sheet(figsize=(13.2, 7.4), layout="constrained")
    sheet.suptitle(f"triquad on simulated street {_STREET}: 110 m, 100 scans, noise of 1 cm")
    maps = {
        "triquad": (scores, "o-", "#0072b2"),
        "VDBFusion, voxels of 10 cm": (_NEIGHBOUR, "s--", "#d55e00"),
    }
    panels = sheet.subplots(2, 3)
    for column, curve in zip(panels.T, (TIME, BYTES, SPACING), strict=True):
        for panel, measure in zip(column, ("f_score", "accuracy_cm"), strict=True):
            for label, (of, style, colour) in maps.items():
                points = [(one.cost, getattr(one, measure)) for one in of if one.curve == curve]
                panel.plot(*zip(*points, strict=True), style, color=colour, label=label)
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter(ScalarFormatter())
            panel.xaxis.set_minor_formatter(NullFormatter())
            panel.set_xlabel(curve)
            panel.set_ylabel("F-score at 10 cm, %" if measure == "f_score" else "mean error, cm")
            panel.grid(alpha=0.3)
    panels[0, 0].legend()
    sheet.savefig(path, dpi=110)


def _by_time(made: DrivenStreet) -> tuple[list[Scored], Epoch]:
    """Return scores after some seconds of integrating scans and training, of all cores together.

    The epoch is that of the settled map, of all scans.
    """
    mapper = Mapper("bench", Settings(), "cpu")
    began_s = time.process_time()
    for scan in made.scans:
        mapper.ingest(scan.points, scan.world_from_sensor)
    taken_s = time.process_time() - began_s
    scores: list[Scored] = []
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
            scores.append(_score(epoch.record(), made, curve=TIME, cost=cost))
            report(number + 1, f"{cost:.1f} s")
    return scores, epoch


def _by_bytes(epoch: Epoch, made: DrivenStreet) -> list[Scored]:
    """Return scores of a map's file, as it is and packed within errors."""
    with tempfile.NamedTemporaryFile() as plain:
        size = written(epoch, epoch.record(), cast(BinaryIO, plain)).bytes
        plain.flush()
        stored = read_map(plain.name)
    scores = [_score(stored, made, curve=BYTES, cost=size / 1e6)]
    with progress("packing", len(_ERRORS_M)) as report:
        for number, error_m in enumerate(_ERRORS_M):
            packed = quantise(stored, error_m).record
            size = written(epoch, packed, io.BytesIO()).bytes
            scores.append(_score(packed, made, curve=BYTES, cost=size / 1e6))
            report(number + 1, f"within {1e3 * error_m:g} mm")
    return scores


def _score(record: MapRecord, made: DrivenStreet, *, curve: str, cost: float) -> Scored:
    with OfflineMap(record) as opened:
        scores = made.mesh_scores(opened.mesh(made.drive.scene.box))
    return Scored(curve, cost, 100 * scores.f_score, 100 * scores.accuracy_m)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure a street, and draw it."""
    parser = argparse.ArgumentParser(prog="tradeoffs", description=__doc__)
    parser.add_argument("picture", type=picture, metavar="OUT.png")
    options = parser.parse_args(argv)
    draw(measure_tradeoffs(bench_street(_STREET)), options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
