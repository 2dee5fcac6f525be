"""What vanished and appeared, in map files made from simulated scans of a street."""

import dataclasses
import json
from functools import cache

import numpy as np
import pytest
from support.maps.small_world import settings, settle
from triquad_client import OfflineMap
from triquad_format.mapfile.writer import write_map
from triquad_server.mapping.mapper import Mapper
from triquad_tools.commands.inspect import main
from triquad_tools.mapfiles.diff import compare
from triquad_tools.mapfiles.object_changes import LEAST_POINTS, object_changes
from triquad_tools.simulation.lidar import Lidar, drive
from triquad_tools.simulation.solids import box
from triquad_tools.simulation.street import street

LIDAR = Lidar(columns=360, range_max_m=12.0)  # small maps are compared quickly
VANISHES = (4.0, 1.5)
APPEARS = (9.0, 1.8)
MOVES = (12.0, 0.8)
MOVED = (13.5, 0.8)


@cache
def mapped(seed, *places):
    """A map of a drive of 15 m along a street with boxes of 1.2 m, 2 m high, on its road."""
    scene = street(3)
    boxes = tuple(box((x, y, 0.0), (0.6, 0.6, 2.0)) for x, y in places)
    scene = dataclasses.replace(scene, solids=scene.solids + boxes)
    mapper = Mapper("street", settings(samples_per_ray=8.0), "cpu")
    rng = np.random.default_rng(seed)
    for pose in drive(scene, 12, 1.4):
        scan = LIDAR.scan(scene, pose, rng)
        mapper.ingest(scan.points, scan.world_from_sensor)
    settle(mapper)
    return mapper.publish().record()


def before():
    return mapped(1, VANISHES, MOVES)


def after():
    return mapped(2, APPEARS, MOVED)


def objects(a, b):
    with OfflineMap(a) as old, OfflineMap(b) as new:
        return object_changes(compare(old, new))


@pytest.fixture(scope="module")
def found():
    return objects(before(), after())


def test_what_vanished_and_what_appeared_is_told_apart(found):
    """What moved did both."""
    for clusters, places in (
        (found["vanished"], (VANISHES, MOVES)),
        (found["appeared"], (APPEARS, MOVED)),
    ):
        by_x = sorted(cluster.middle_m[:2].tolist() for cluster in clusters)
        np.testing.assert_allclose(by_x, places, atol=0.35)
        for cluster in clusters:
            np.testing.assert_allclose(cluster.size_m[:2], 1.2, atol=0.4)
            assert 1.7 <= cluster.high_m[2] <= 2.3
            assert cluster.points > 100


def test_where_a_box_stood_the_road_is_newly_seen_and_under_it_no_longer_known(found):
    def has_road_at(clusters, place):
        return any(
            np.linalg.norm(cluster.middle_m[:2] - place) < 0.5 and abs(cluster.middle_m[2]) < 0.1
            for cluster in clusters
        )

    assert has_road_at(found["newly_seen"], MOVES)
    assert has_road_at(found["no_longer_known"], APPEARS)
    assert not has_road_at(found["vanished"] + found["appeared"], MOVES)


def test_another_drive_with_other_noise_shows_no_objects():
    found = objects(before(), mapped(3, VANISHES, MOVES))
    assert found["vanished"] == found["appeared"] == []


def test_where_only_one_map_has_been_nothing_appeared_or_vanished():
    nowhere = dataclasses.replace(before(), regions=())
    found = objects(before(), nowhere)
    assert found["vanished"] == found["appeared"] == found["newly_seen"] == []
    assert max(cluster.points for cluster in found["no_longer_known"]) > 10_000
    assert all(cluster.points >= LEAST_POINTS for cluster in found["no_longer_known"])


# The command


@pytest.fixture
def files(tmp_path):
    paths = [tmp_path / name for name in ("a.triquad", "b.triquad")]
    for path, record in zip(paths, (before(), after()), strict=True):
        write_map(record, path)
    return [str(path) for path in paths]


def test_the_table_lists_them_and_programs_get_all(files, capsys):
    assert main([*files, "--diff"]) == 0
    lines = capsys.readouterr().out.splitlines()
    start = next(number for number, line in enumerate(lines) if line.split()[0] == "what")
    kinds = [line.split()[0] for line in lines[start + 1 : start + 5]]
    assert kinds == ["vanished", "vanished", "appeared", "appeared"]
    assert main([*files, "--diff", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["objects"]
    assert found["vanished"][0].keys() == {"low_m", "high_m", "points"}
    assert found.keys() == {"vanished", "appeared", "newly_seen", "no_longer_known", "moved"}
