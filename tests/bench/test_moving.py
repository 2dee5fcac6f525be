"""The part of the benchmark in which things move, on very few scans of a coarse lidar."""

import pytest
from triquad_tools.simulation.lidar import Lidar

from bench.parts.moving import Followed, follow
from bench.scenes.traffic import Traffic, street_traffic, thin_things

BUSY, EMPTY = 6, 10
LIDAR = Lidar(beams=32, columns=512)
THIN = tuple(thin_things(6.0, -2.5))

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    return street_traffic(1, BUSY, BUSY + EMPTY, LIDAR).among(THIN)


@pytest.fixture(scope="module")
def followed(traffic: Traffic) -> Followed:
    return follow(traffic, THIN, (0, EMPTY))


def test_what_moved_is_forgotten_and_what_stands_is_kept(followed: Followed) -> None:
    busy, empty = followed.looks.values()
    assert busy.trail_left > 0.8
    assert empty.trail_left < 0.2
    assert empty.static_kept > 0.99
    assert 0.5 < empty.thin_kept <= 1.0
    assert empty.air_in_trail > busy.air_in_trail
    assert busy.ghost_m2 > 5.0
    assert empty.ghost_m2 < 0.1 * busy.ghost_m2


def test_the_lane_is_free_once_nothing_drives_there(followed: Followed) -> None:
    busy, empty = followed.looks.values()
    assert busy.lane_blocked_m > 3
    assert empty.lane_blocked_m < busy.lane_blocked_m
