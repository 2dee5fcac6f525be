"""Two maps of one frame become one: as if one robot had seen all."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import servers
from support.maps.map_records import random_record
from support.recordings.kitti_folder import write_folder
from triquad_client import Status, open_map
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_tools.commands.map_recording import main as map_recording
from triquad_tools.commands.pack import main

EACH_M = 4.0
START_NS, LATER_NS = 10**18, 10**18 + 10**12
SMALL_M, LARGE_M = 3.0, 4.0
LOOKS = 8  # scans


def mapped(path: Path, places: range, stamp_ns: int, radius_m: float = LARGE_M) -> Path:
    """The map of scans along x, each of a sphere around it, with its training state."""
    return _mapped(path, EACH_M * np.array(places, float), stamp_ns, radius_m)


def looked(path: Path, stamp_ns: int, radius_m: float) -> Path:
    """The map of some scans at one place."""
    return _mapped(path, np.zeros(LOOKS), stamp_ns, radius_m)


def _mapped(path: Path, xs: NDArray[np.float64], stamp_ns: int, radius_m: float) -> Path:
    scans = [servers.sphere(4000, radius_m)] * len(xs)
    poses = np.tile(np.eye(4), (len(xs), 1, 1))
    poses[:, 0, 3] = xs
    stamps = [stamp_ns + number * 10**8 for number in range(len(xs))]
    write_folder(path.with_suffix(""), scans, poses, stamps)
    words = [str(path.with_suffix("")), str(path), "--settings", str(servers.SMALL_FILE)]
    assert map_recording([*words, "--training"]) == 0
    return path


def status_at(path: Path, points: NDArray[np.floating]) -> NDArray[np.uint8]:
    with open_map(path) as opened:
        return opened.query_sdf(points.astype(np.float64)).status


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("merge")


@pytest.fixture(scope="module")
def west(folder: Path) -> Path:
    return mapped(folder / "west.triquad", range(8), START_NS)


@pytest.fixture(scope="module")
def east(folder: Path) -> Path:
    return mapped(folder / "east.triquad", range(12, 4, -1), LATER_NS)


def test_two_robots_make_the_map_that_one_makes(west: Path, east: Path, tmp_path: Path) -> None:
    output = tmp_path / "both.triquad"
    assert main(["--merge", str(west), str(east), str(output)]) == 0
    whole = mapped(tmp_path / "whole.triquad", range(13), START_NS)
    both, one = read_map(output), read_map(whole)
    assert {region.index for region in both.regions} == {region.index for region in one.regions}
    assert both.progress.scans_taken == 8 + 8
    assert all(region.training is not None for region in both.regions), "it can be gone on with"
    places = np.linspace(-3.0, 12 * EACH_M + 3.0, 400)[:, None] * [1.0, 0.0, 0.0]
    points = places + servers.sphere(400)
    with open_map(output) as merged, open_map(whole) as alone:
        first, second = merged.query_sdf(points), alone.query_sdf(points)
    assert (first.status == second.status).mean() > 0.99
    near = (np.abs(second.sdf) < 0.2) & (second.status == Status.SURFACE)
    assert near.sum() > 100
    assert np.median(np.abs(first.sdf - second.sdf)[near]) < 0.03


def test_a_region_that_one_knows_alone_stays_as_it_is(
    west: Path, east: Path, tmp_path: Path
) -> None:
    output = tmp_path / "both.triquad"
    assert main(["--merge", str(east), str(west), str(output)]) == 0
    parts = [{one.index: one for one in read_map(path).regions} for path in (west, east, output)]
    alone = set(parts[0]) ^ set(parts[1])
    assert alone
    for index in alone:
        before, after = (parts[0].get(index) or parts[1][index]), parts[2][index]
        for mine, theirs in zip(after.tables, before.tables, strict=True):
            np.testing.assert_array_equal(mine.vectors(), theirs.vectors())
        np.testing.assert_array_equal(after.evidence.surface, before.evidence.surface)


@pytest.mark.parametrize("first", ["small", "large"])
def test_the_later_one_is_right_where_they_contradict(tmp_path: Path, first: str) -> None:
    """A sphere stood within a larger one, and was taken away; or was put there."""
    stamps = {"small": START_NS, "large": LATER_NS}
    if first == "large":
        stamps = {"small": LATER_NS, "large": START_NS}
    radii = {"small": SMALL_M, "large": LARGE_M}
    paths = [looked(tmp_path / f"{name}.triquad", stamps[name], radii[name]) for name in radii]
    for number, pair in enumerate((paths, paths[::-1])):
        output = tmp_path / f"{number}.triquad"
        assert main(["--merge", str(pair[0]), str(pair[1]), str(output)]) == 0
        inner = status_at(output, servers.sphere(500, SMALL_M))
        outer = status_at(output, servers.sphere(500, LARGE_M))
        assert (outer == Status.SURFACE).mean() > 0.95
        is_there = (inner == Status.SURFACE).mean()
        assert is_there > 0.95 if first == "large" else is_there < 0.05


def test_a_file_without_training_state_can_be_had(west: Path, east: Path, tmp_path: Path) -> None:
    output = tmp_path / "both.triquad"
    assert main(["--merge", str(west), str(east), str(output), "--no-training"]) == 0
    assert all(region.training is None for region in read_map(output).regions)


def test_maps_that_do_not_fit_are_refused(
    west: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = read_map(west)
    bare = replace(record, regions=tuple(replace(one, training=None) for one in record.regions))
    others = {
        "no rays to learn from": bare,
        "different origins": replace(record, origin_m=(100.0, 0.0, 0.0)),
        "the same [field] settings": random_record(1),
    }
    for told, other in others.items():
        path = tmp_path / "other.triquad"
        write_map(other, path)
        output = tmp_path / "out.triquad"
        assert main(["--merge", str(west), str(path), str(output)]) == 2
        assert told in capsys.readouterr().err
        assert not output.exists()
    words = [str(west), str(tmp_path / "out.triquad"), "--crop", *"000111"]
    assert main(["--merge", str(west), *words]) == 2
    assert "--merge is of whole maps" in capsys.readouterr().err
