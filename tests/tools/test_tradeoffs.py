"""Accuracy by time, bytes and scan spacing, on a short drive with a coarse lidar."""

import pytest
from triquad_tools.benchmarks.figures import Figure
from triquad_tools.benchmarks.street import BenchStreet
from triquad_tools.benchmarks.tradeoff_sheet import ACCURACY, BYTES, F_SCORE, SPACING, TIME
from triquad_tools.benchmarks.tradeoffs import measure_tradeoffs
from triquad_tools.evaluation.map_scores import driven_street
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street


@pytest.fixture(scope="module")
def figures() -> list[Figure]:
    scene = street(2, 20.0)
    made = driven_street(SimulatedDrive(scene, Lidar(columns=128), drive(scene, 10, 1.0), seed=2))
    visible = made.drive.true_hits(0.1)
    few = 300_000  # samples of a mesh, where all would be a million and a half
    return measure_tradeoffs(
        BenchStreet(made.drive, made.scans, made.probes, visible=visible, samples_max=few)
    )


def curve_of(figures: list[Figure], curve: str, measure: str) -> list[tuple[float, float]]:
    points = [
        (one.point.cost, one.value)
        for one in figures
        if one.point and (one.point.curve, one.point.measure) == (curve, measure)
    ]
    assert all(one.point is not None for one in figures)
    return points


def test_more_time_makes_better_maps(figures: list[Figure]) -> None:
    spent, scores = zip(*curve_of(figures, TIME, F_SCORE), strict=True)
    assert list(spent) == sorted(spent)
    assert len(spent) >= 2
    assert scores[-1] > scores[0]


def test_fewer_bytes_move_the_surface_by_little(figures: list[Figure]) -> None:
    sizes, errors_cm = zip(*curve_of(figures, BYTES, ACCURACY), strict=True)
    assert list(sizes) == sorted(sizes, reverse=True)  # as it is, then within larger errors
    assert sizes[-1] < 0.5 * sizes[0]
    assert abs(errors_cm[1] - errors_cm[0]) < 0.1  # within a millimetre
    assert errors_cm[-1] < errors_cm[0] + 2.0


def test_fewer_scans_make_worse_maps(figures: list[Figure]) -> None:
    every, scores = zip(*curve_of(figures, SPACING, F_SCORE), strict=True)
    assert every == (1, 2, 5, 10)
    assert scores[0] > scores[2] > scores[3]
