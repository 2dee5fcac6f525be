"""The part of the benchmark in which things move, on very few scans of a coarse lidar."""

import numpy as np
import pytest
from triquad_tools.benchmarks.moving import Followed, follow, thin_kept
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.traffic import Traffic, street_traffic

BUSY, EMPTY = 6, 10


@pytest.fixture(scope="module")
def traffic() -> Traffic:
    return street_traffic(1, BUSY, BUSY + EMPTY, Lidar(beams=32, columns=512))


@pytest.fixture(scope="module")
def followed(traffic: Traffic) -> Followed:
    return follow(traffic, (0, EMPTY))


def test_a_map_is_looked_at_when_it_should_be(traffic: Traffic, followed: Followed) -> None:
    assert list(followed.looks) == [0, EMPTY]
    assert len(followed.ingest_s) == len(traffic)
    busy, empty = followed.looks.values()
    assert busy.epoch.number < empty.epoch.number
    assert len(empty.static) > len(busy.static)


def test_the_trail_is_where_only_moving_things_were(followed: Followed) -> None:
    look = followed.looks[0]
    assert len(look.trail) > 100
    assert look.scene.sdf(look.trail).min() > 0.35
    both = np.concatenate([look.trail, look.static])
    assert len(np.unique(np.rint(both / look.epoch.voxel_m - 0.5), axis=0)) == len(both)


def test_what_moved_is_forgotten_and_what_stands_is_kept(followed: Followed) -> None:
    busy, empty = followed.looks.values()
    assert busy.trail_left > 0.8
    assert empty.trail_left < 0.2
    assert empty.static_kept > 0.99
    assert empty.air_in_trail > busy.air_in_trail
    assert busy.ghost_m2 > 5.0
    assert empty.ghost_m2 < 0.1 * busy.ghost_m2


def test_most_of_thin_things_is_kept(traffic: Traffic) -> None:
    assert 0.5 < thin_kept(traffic) <= 1.0
