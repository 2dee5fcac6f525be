"""Two maps of one frame become one: as if one robot had seen all."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import servers
from support.maps import small_world
from support.maps.map_records import random_record, with_rays
from support.recordings.kitti_folder import write_folder
from triquad_client import Status, open_map
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.pose import upright_pose
from triquad_tools.commands.map_recording import main as map_recording
from triquad_tools.commands.pack import main
from triquad_tools.simulation.lidar import Lidar, SimulatedScan
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box

EACH_M = 4.0
START_NS, LATER_NS = 10**18, 10**18 + 10**12
SMALL_M, LARGE_M = 3.0, 4.0
LOOKS = 8  # scans
POSE_TOLD = re.compile(r"lies at (\S+) (\S+) (\S+), roll pitch yaw \S+ \S+ (\S+) ")
BOX_M, BOX_HALF_M = (3.0, 0.0, 0.8), 0.8
BOX = box(BOX_M, (BOX_HALF_M,) * 3)  # that comes, or is taken away
OTHER_FRAME = (31.0, -12.0, 0.7, 65.0)  # of a map, in the frame of another one: metres, degrees


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


def street_from(
    path: Path, chosen: range, frame: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
) -> Path:
    """The map of some scans of a street, with its training state, in a frame."""
    return scanned(path, [small_world.world(12).scans[number] for number in chosen], frame)


def scanned(
    path: Path,
    scans: Sequence[SimulatedScan],
    frame: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    stamp_ns: int = START_NS,
) -> Path:
    poses = np.linalg.inv(upright_pose(*frame)) @ [scan.world_from_sensor for scan in scans]
    stamps = [stamp_ns + number * 10**8 for number in range(len(scans))]
    write_folder(path.with_suffix(""), [scan.points for scan in scans], poses, stamps)
    words = [str(path.with_suffix("")), str(path), "--set", "training.samples_per_ray=8"]
    assert map_recording([*words, "--set", "field.depth=8", "--training"]) == 0
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


def test_maps_with_origins_of_their_own_are_aligned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One counts from 20 km away, which is the same place in its own frame."""
    west = street_from(tmp_path / "west.triquad", range(8))
    record = read_map(street_from(tmp_path / "east.triquad", range(11, 3, -1)))
    far, output = tmp_path / "far.triquad", tmp_path / "both.triquad"
    write_map(replace(record, origin_m=(20_000.0, -500.0, 40.0)), far)
    capsys.readouterr()
    guess = ["-20000.4", "500.3", "-40.1", "0"]
    assert main(["--merge", str(far), str(west), str(output), "--align", *guess]) == 0
    both = read_map(output)
    assert both.origin_m == (0.0, 0.0, 0.0)
    seen_s = np.concatenate([region.evidence.seen_s for region in both.regions])
    assert np.abs(seen_s[seen_s > 0] - START_NS / 1e9).max() <= 60.0, "a file has whole minutes"
    drive = small_world.world(12)
    with open_map(output) as merged:
        hits = merged.query_distance(drive.hits[::50])
    assert (hits.status == Status.SURFACE).mean() > 0.95
    assert np.abs(hits.distance_m).mean() < 0.02


def test_a_map_in_a_frame_of_its_own_is_aligned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    west = street_from(tmp_path / "west.triquad", range(8))
    east = street_from(tmp_path / "east.triquad", range(11, 3, -1), OTHER_FRAME)
    both, output = [str(east), str(west)], str(tmp_path / "both.triquad")
    guess = [f"{value:g}" for value in np.add(OTHER_FRAME, (0.6, -0.5, 0.2, 4.0))]
    capsys.readouterr()
    assert main(["--merge", *both, output, "--align", *guess]) == 0
    told = re.search(
        r"lies at (\S+) (\S+) (\S+), roll pitch yaw \S+ \S+ (\S+) ", capsys.readouterr().out
    )
    assert told is not None
    assert np.abs(np.subtract(np.array(told.groups(), float), OTHER_FRAME)).max() < 0.05
    drive = small_world.world(12)
    ways = np.array([scan.world_from_sensor[:3, 3] for scan in drive.scans])
    with open_map(output) as merged:
        hits, way = merged.query_distance(drive.hits[::50]), merged.query_distance(ways)
    assert (hits.status == Status.SURFACE).mean() > 0.95
    assert np.abs(hits.distance_m).mean() < 0.02
    assert (way.status == Status.FREE).all()
    assert np.abs(way.distance_m - drive.scene.sdf(ways)).max() < 0.1, (
        "no surface that is not there"
    )
    turned = [*guess[:3], f"{OTHER_FRAME[3] + 90:g}"]
    assert main(["--merge", *both, output, "--force", "--align", *turned]) == 2
    assert "do not fit near the guess" in capsys.readouterr().err
    assert main(["--merge", *both, output, "--force", "--align", "900", "0", "0", "0"]) == 2
    assert "no surface in common" in capsys.readouterr().err


@pytest.mark.parametrize("is_later", ["what stood there", "what is empty"])
def test_of_maps_in_two_frames_the_later_one_is_right(tmp_path: Path, is_later: str) -> None:
    solids = {"what stood there": (*small_world.WALLED, BOX), "what is empty": small_world.WALLED}
    paths = {}
    for name, of in solids.items():
        scene = Scene(of, np.array(small_world.WALLED_BOUNDS))
        rng = np.random.default_rng(0)
        places = [upright_pose(-4.0 + 0.3 * number, 0.0, 1.7, 0.0) for number in range(LOOKS)]
        scans = [Lidar(columns=360).scan(scene, place, rng) for place in places]
        frame = OTHER_FRAME if name == "what stood there" else (0.0, 0.0, 0.0, 0.0)
        stamp_ns = LATER_NS if name == is_later else START_NS
        paths[name] = scanned(tmp_path / f"{name}.triquad", scans, frame, stamp_ns)
    output = tmp_path / "both.triquad"
    words = ["--merge", *map(str, paths.values()), str(output)]
    assert main([*words, "--align", *map(str, OTHER_FRAME)]) == 0
    across = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 3)) * (0, 1, 1)
    front = status_at(output, np.subtract(BOX_M, (BOX_HALF_M, 0, 0)) + across)
    is_there = (front == Status.SURFACE).mean()
    assert is_there > 0.9 if is_later == "what stood there" else is_there < 0.1


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
        "the same [field] settings": with_rays(random_record(1), 40),
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
