import json
import math

import pytest
from support.maps.exact_maps import exact_map, flat, table
from support.maps.map_records import random_record
from support.maps.small_world import settings, settled_epoch, settled_mapper, world
from triquad_client import OfflineMap
from triquad_format.mapfile.writer import write_map
from triquad_tools.commands.inspect import main
from triquad_tools.mapfiles.diff import compare, difference

GROUND = exact_map(flat(0.1))
RAISED = exact_map(table(0.1, 0.15))  # by 5 cm, in a square of 4 m
TABLE = exact_map(table(0.1, 1.1))  # a metre high, in the same square
POINTS = 100 * 100  # the ground is seen in a square of 20 m, a voxel is 0.2 m wide
IN_SQUARE = 20 * 20


def diff(a, b, tile_m=1.0):
    with OfflineMap(a) as old, OfflineMap(b) as new:
        return difference(compare(old, new), tile_m)


def tile_at(found, *corner):
    return next(tile for tile in found.tiles if tile.low_m == corner)


def test_a_map_does_not_differ_from_itself():
    found = diff(RAISED, RAISED)
    assert found.tiles == ()
    assert found.total.points_a == found.total.points_b == POINTS
    assert found.total.moved_p95_m < 2e-4


def test_what_moved_by_5_cm_is_found_to_have_moved_by_5_cm():
    found = diff(GROUND, RAISED)
    for tile in found.tiles:
        assert max(map(abs, (*tile.low_m[:2], *tile.high_m[:2]))) <= 3.0
        assert tile.change.appeared == tile.change.vanished == 0
    inner = tile_at(found, 0.0, 0.0, 0.0).change
    assert inner.points_a == inner.points_b == 25
    assert inner.moved_median_m == pytest.approx(0.05, abs=2e-4)
    assert inner.moved_p95_m == pytest.approx(0.05, abs=2e-4)
    assert inner.changed_m3 == pytest.approx(25 * 0.2**2 * 0.05, rel=0.01)
    assert found.total.moved_median_m < 2e-4
    volumes = [tile.change.changed_m3 for tile in found.tiles]
    assert volumes == sorted(volumes, reverse=True)


def test_what_appeared_was_free_and_hides_what_is_below():
    found = diff(GROUND, TABLE)
    top = tile_at(found, 0.0, 0.0, 1.0).change
    assert (top.points_a, top.points_b, top.appeared, top.newly_seen) == (0, 25, 25, 0)
    assert math.isnan(top.moved_median_m)
    below = tile_at(found, 0.0, 0.0, 0.0).change
    assert (below.points_a, below.points_b, below.no_longer_known, below.vanished) == (25, 0, 25, 0)
    assert 0 < found.total.appeared <= IN_SQUARE
    assert found.total.vanished == 0


def test_maps_of_different_places_have_seen_nothing_of_each_other():
    found = diff(GROUND, random_record(indices=()))
    assert found.total.no_longer_known == found.total.points_a == POINTS
    assert found.total.changed_m3 == 0.0
    assert diff(random_record(indices=()), GROUND).total.newly_seen == POINTS


def test_the_same_scans_give_maps_that_differ_by_their_noise_alone():
    few = settled_mapper(settings(samples_per_ray=9.0), world()).changes_since(None).record
    many = settled_epoch().record()
    total = diff(few, many, 6.4).total
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
    assert lines[2].split()[:3] == ["from", "x", "m"]
    (total,) = (number for number, line in enumerate(lines) if line.startswith("  all"))
    assert lines[total + 1].split()[0] == "what"
    assert {line.split()[0] for line in lines[total + 2 :]} >= {"appeared"}


def test_json(files, capsys):
    assert main([*files, "--diff", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["tile_m"] == pytest.approx(6.4)
    assert found["total"]["points_a"] == POINTS
    assert found["total"]["appeared"] > 0
    assert set(found["tiles"][0]) == {"low_m", "high_m", "change"}
    assert found["tiles"][0]["change"].keys() == found["total"].keys()


def test_nothing_to_tell(files, capsys):
    assert main([files[0], files[0], "--diff"]) == 0
    assert "no difference at 10,000 surface points" in capsys.readouterr().out
