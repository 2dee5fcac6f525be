"""Accuracy by time, bytes and scan spacing, on a short drive with a coarse lidar."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from triquad_tools.evaluation.map_scores import driven_street
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

from bench.street import BenchStreet
from bench.studies.tradeoffs import BYTES, SPACING, TIME, Scored, draw, measure_tradeoffs

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def scores() -> list[Scored]:
    scene = street(2, 20.0)
    made = driven_street(SimulatedDrive(scene, Lidar(columns=128), drive(scene, 10, 1.0), seed=2))
    visible = made.drive.true_hits(0.1)
    few = 300_000  # samples of a mesh, where all would be a million and a half
    return measure_tradeoffs(
        BenchStreet(made.drive, made.scans, made.probes, visible=visible, samples_max=few)
    )


def curve_of(scores: list[Scored], curve: str) -> list[Scored]:
    return [one for one in scores if one.curve == curve]


def test_more_time_makes_better_maps(scores: list[Scored]) -> None:
    by_time = curve_of(scores, TIME)
    assert [one.cost for one in by_time] == sorted(one.cost for one in by_time)
    assert len(by_time) >= 2
    assert by_time[-1].f_score > by_time[0].f_score


def test_fewer_bytes_move_the_surface_by_little(scores: list[Scored]) -> None:
    by_bytes = curve_of(scores, BYTES)
    sizes = [one.cost for one in by_bytes]
    errors_cm = [one.accuracy_cm for one in by_bytes]
    assert sizes == sorted(sizes, reverse=True)  # as it is, then within larger errors
    assert sizes[-1] < 0.5 * sizes[0]
    assert abs(errors_cm[1] - errors_cm[0]) < 0.1  # within a millimetre
    assert errors_cm[-1] < errors_cm[0] + 2.0


def test_fewer_scans_make_worse_maps(scores: list[Scored]) -> None:
    by_spacing = curve_of(scores, SPACING)
    assert [one.cost for one in by_spacing] == [1, 2, 5, 10]
    assert by_spacing[0].f_score > by_spacing[2].f_score > by_spacing[3].f_score


def test_the_curves_are_drawn(scores: list[Scored], tmp_path: Path) -> None:
    path = tmp_path / "curves.png"
    draw(scores, path, title="a short street", neighbour=True)
    near = {
        colour: np.abs(255 * imread(path)[..., :3] - colour).max(axis=2) < 3
        for colour in ((0, 114, 178), (213, 94, 0))
    }
    assert all(pixels.sum() > 500 for pixels in near.values())
