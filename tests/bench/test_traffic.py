import numpy as np
import pytest
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene

from bench.scenes.traffic import Traffic, lies_on, street_traffic, thin_things

LIDAR = Lidar(beams=32, columns=256)
BUSY = 8


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    return street_traffic(3, BUSY, BUSY + 2, LIDAR)


def test_points_are_told_apart_by_whether_what_they_lie_on_moves(traffic: Traffic) -> None:
    scan = traffic.scan(4)
    assert scan.moving.any()
    assert len(scan.moving) == len(scan.points)
    on_street = lies_on(traffic.standing.scene, scan.true_hits)
    np.testing.assert_array_equal(on_street, ~scan.moving)


def test_things_move_from_scan_to_scan(traffic: Traffic) -> None:
    before, after = (traffic.scan(index) for index in (3, 4))
    solids = tuple(traffic.movers(0.3))
    there = Scene(solids, traffic.standing.scene.bounds)
    assert lies_on(there, before.true_hits[before.moving]).all()
    assert not lies_on(there, after.true_hits[after.moving]).all()


def test_in_the_end_the_street_is_as_if_nothing_had_moved(traffic: Traffic) -> None:
    assert len(traffic) == BUSY + 2
    assert traffic.scan(BUSY - 1).moving.any()
    for index in (BUSY, BUSY + 1):
        scan = traffic.scan(index)
        assert not scan.moving.any()
        np.testing.assert_array_equal(scan.points, traffic.standing.scan(index).points)


def test_things_that_stand_among_others_are_seen_and_do_not_move(traffic: Traffic) -> None:
    things = thin_things(6.0, -2.5)
    scan = traffic.among(things).scan(4)
    on_things = lies_on(Scene(tuple(things), traffic.standing.scene.bounds), scan.true_hits)
    assert on_things.any()
    assert not scan.moving[on_things].any()
