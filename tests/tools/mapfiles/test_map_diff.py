import json
import math

import numpy as np
import pytest
from support.maps.exact_maps import exact_map, flat, table
from support.maps.map_records import random_record
from support.maps.small_world import settings, settled_epoch, settled_mapper, world
from triquad_client import OfflineMap
from triquad_format.mapfile.writer import write_map
from triquad_format.records.status import Status
from triquad_tools.commands.inspect import main
from triquad_tools.mapfiles.diff import compare, difference
from triquad_tools.mapfiles.object_changes import object_changes

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
    few = settled_mapper(settings(samples_per_ray=9.0), world()).changes_since(None).record
    many = settled_epoch().record()
    total = difference(compared(few, many))
    assert total.points_a > 10_000
    assert total.moved_median_m < 0.01
    assert total.moved_p95_m < 0.06
    for count in (total.appeared, total.vanished, total.newly_seen, total.no_longer_known):
        assert count < 0.002 * total.points_a


# The command


@pytest.fixture
def files(tmp_path):
    paths = [tmp_path / name for name in ("a.triquad", "b.triquad")]
    for path, record in zip(paths, (GROUND, TABLE), strict=True):
        write_map(record, path, feature_dtype="<f4")
    return [str(path) for path in paths]


def test_table(files, capsys):
    assert main([*files, "--diff"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [
        f"{letter}  {path}: map 'ground', epoch 1" for letter, path in zip("AB", files, strict=True)
    ]
    assert lines[2].split()[:2] == ["points", "A"]
    assert lines[3].split()[0] == "10,000"
    assert lines[4].split()[0] == "what"
    assert {line.split()[0] for line in lines[5:]} >= {"appeared"}


def test_json(files, capsys):
    assert main([*files, "--diff", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["total"]["points_a"] == POINTS
    assert found["total"]["appeared"] > 0
    assert found["objects"]["appeared"][0].keys() == {"low_m", "high_m", "points"}


def test_nothing_to_tell(files, capsys):
    assert main([files[0], files[0], "--diff"]) == 0
    assert "no difference at 10,000 surface points" in capsys.readouterr().out
