"""What differs between two maps, and what vanished and appeared; of exact maps and of streets."""

import dataclasses
import json
import math
from functools import cache

import numpy as np
import pytest
from support.maps.exact_maps import exact_map, flat, table
from support.maps.map_records import random_record
from support.maps.small_world import settings, settle, settled_epoch, settled_mapper, world
from triquad_client import OfflineMap
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.status import Status
from triquad_server.mapping.mapper import Mapper
from triquad_tools.commands.inspect import main
from triquad_tools.mapfiles.diff import (
    LEAST_POINTS,
    Change,
    Cluster,
    compare,
    difference,
    object_changes,
    print_diff,
    print_objects,
)
from triquad_tools.simulation.lidar import Lidar, drive
from triquad_tools.simulation.solids import box
from triquad_tools.simulation.street import street

GROUND = exact_map(flat(0.1))
RAISED = exact_map(table(0.1, 0.15))  # by 5 cm, in a square of 4 m
TABLE = exact_map(table(0.1, 1.1))  # a metre high, in the same square
POINTS = 100 * 100  # the ground is seen in a square of 20 m, a voxel is 0.2 m wide
IN_SQUARE = 20 * 20


def compared(a, b):
    with OfflineMap(a) as old, OfflineMap(b) as new:
        return compare(old, new)


def test_a_map_does_not_differ_from_itself():
    found = compared(RAISED, RAISED)
    total = difference(found)
    assert not total.differs
    assert total.points_a == total.points_b == POINTS
    assert total.moved_p95_m < 2e-4
    assert not any(object_changes(found).values())


def test_what_moved_by_5_cm_is_found_to_have_moved_by_5_cm():
    found = compared(GROUND, RAISED)
    total = difference(found)
    assert total.differs
    assert total.appeared == total.vanished == 0
    assert total.moved_median_m < 2e-4
    moved = found.changed["moved"]
    np.testing.assert_allclose(np.abs(moved.sdf[inner(moved)]), 0.05, atol=2e-4)
    (cluster,) = object_changes(found)["moved"]
    np.testing.assert_allclose(cluster.middle_m[:2], 0.0, atol=0.1)
    np.testing.assert_allclose(cluster.size_m[:2], 4.0, atol=0.4)
    assert cluster.points == pytest.approx(IN_SQUARE, rel=0.15)


def inner(sighting):
    return np.abs(sighting.points[:, :2]).max(axis=1) < 1.5


def test_what_appeared_was_free_and_hides_what_is_below():
    found = compared(GROUND, TABLE)
    top = found.new.part(np.flatnonzero(found.new.points[:, 2] > 0.6))
    assert inner(top).any()
    assert (top.status[inner(top)] == Status.FREE).all()
    below = found.old.part(np.flatnonzero(inner(found.old)))
    assert (below.status == Status.UNKNOWN).all()
    total = difference(found)
    assert 0 < total.appeared <= IN_SQUARE
    assert total.vanished == 0


def test_maps_of_different_places_have_seen_nothing_of_each_other():
    nowhere = random_record(indices=())
    total = difference(compared(GROUND, nowhere))
    assert total.no_longer_known == total.points_a == POINTS
    assert math.isnan(total.moved_median_m)
    assert difference(compared(nowhere, GROUND)).newly_seen == POINTS


def test_the_same_scans_give_maps_that_differ_by_their_noise_alone():
    few = settled_mapper(settings(samples_per_ray=9.0), world()).snapshot_since(None).record()
    many = settled_epoch().record()
    total = difference(compared(few, many))
    assert total.points_a > 10_000
    assert total.moved_median_m < 0.01
    assert total.moved_p95_m < 0.06
    for count in (total.appeared, total.vanished, total.newly_seen, total.no_longer_known):
        assert count < 0.002 * total.points_a


# What vanished and appeared, in maps made from simulated scans of a street

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


@pytest.fixture(scope="module")
def found():
    return object_changes(compared(before(), after()))


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
    found = object_changes(compared(before(), mapped(3, VANISHES, MOVES)))
    assert found["vanished"] == found["appeared"] == []


def test_where_only_one_map_has_been_nothing_appeared_or_vanished():
    nowhere = dataclasses.replace(before(), regions=())
    found = object_changes(compared(before(), nowhere))
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


def points_of(path):
    """How many points of surface of a file are compared, as the command writes it."""
    record = read_map(path)
    return f"{difference(compared(record, record)).points_a:,}"


def test_the_table_lists_what_differs(files, capsys):
    assert main([*files, "--diff"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for letter, path, record, line in zip("AB", files, (before(), after()), lines, strict=False):
        assert line == f"{letter}  {path}: map 'street', epoch {record.epoch}"
    assert lines[2].split()[:2] == ["points", "A"]
    assert lines[3].split()[0] == points_of(files[0])
    assert lines[4].split()[0] == "what"
    kinds = [line.split()[0] for line in lines[5:9]]
    assert kinds == ["vanished", "vanished", "appeared", "appeared"]


def test_of_many_clusters_the_largest_of_each_kind_are_listed_and_the_rest_is_counted(capsys):
    moved = [Cluster((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), points) for points in range(83, 20, -1)]
    print_objects({"vanished": moved[-2:], "no_longer_known": moved[:6], "moved": moved})
    titles, *rows, more = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in rows] == ["vanished"] * 2 + ["no"] * 5 + ["moved"] * 5
    assert [line.split()[1] for line in rows[-5:]] == ["83", "82", "81", "80", "79"]
    assert more == "  and smaller ones: 1 no longer known, 58 moved; --json prints all"


@pytest.mark.parametrize(("vanished", "is_told"), [(370, True), (30, False)])
def test_maps_in_two_frames_are_told(capsys, vanished, is_told):
    change = Change(1000, 1000, 500, vanished, 0, 0, 0, moved_median_m=0.01, moved_p95_m=0.1)
    print_diff(change)
    assert ("are both in one frame?" in capsys.readouterr().out) == is_told


def test_programs_get_all(files, capsys):
    assert main([*files, "--diff", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["total"]["appeared"] > 0
    objects = found["objects"]
    assert objects["vanished"][0].keys() == {"low_m", "high_m", "points"}
    assert objects.keys() == {"vanished", "appeared", "newly_seen", "no_longer_known", "moved"}


def test_nothing_to_tell(files, capsys):
    assert main([files[0], files[0], "--diff"]) == 0
    assert f"no difference at {points_of(files[0])} surface points" in capsys.readouterr().out
