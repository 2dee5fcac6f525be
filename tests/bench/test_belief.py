"""What a map believes where things came and went, on few scans of a coarse lidar."""

import pytest
from support.maps.episodes import box_on_a_street

from bench.parts.belief import Seen, follow
from bench.scenes.episodes import STANDING

BUSY, EMPTY = 6, 14

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def seen() -> Seen:
    return follow(box_on_a_street(BUSY, EMPTY, rain=0.01))


def test_each_return_is_told_by_what_it_comes_from() -> None:
    made = box_on_a_street(BUSY, 1, rain=0.1)
    assert made.names == ["box", "rain"]
    scans = list(made)
    assert {*scans[0].thing_of.tolist()} == {STANDING, 0, 1}
    assert {*scans[BUSY].thing_of.tolist()} == {STANDING}


def test_what_left_is_forgotten_and_what_stands_is_kept(seen: Seen) -> None:
    amid, count = seen.left["box amid it"][0]
    assert amid > 0.9 * count > 20
    left, passed = seen.left["box"][3]
    assert left < 0.3 * passed > 20
    assert seen.kept["static"] > 0.98
    assert 0.5 < seen.kept["thin things"] <= 1.0
    assert seen.blocked_m == {10: 0}


def test_drops_of_rain_are_no_surface(seen: Seen) -> None:
    surface, drops = seen.left["rain amid it"][0]
    assert surface < 0.1 * drops
