"""The guides' examples, run as their readers do, against a server that has seen the street."""

import re
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
import triquad_client
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree
from support import servers
from support.poses import shifted
from support.ros.ros_bridge import bridging
from triquad_server.settings import Settings, StoreSettings, TrainingSettings
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.street import street

DOCS = Path(__file__).parents[3] / "docs"
EXAMPLES = DOCS / "examples"
SETTINGS = Settings(training=TrainingSettings(batch=4096, samples_per_ray=8.0))
SCENE = street(1)  # of triquad-demo, which the guides begin with
DRIVE = SimulatedDrive(SCENE, Lidar(columns=360), drive(SCENE, 20, 1.5), seed=1)
RADIUS_M = 0.4  # of what the planners move
TRUE_POSE = shifted(12.0, -1.6, 1.8)

Run = Callable[..., str]


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """Of a server with a map like that of triquad-demo: fewer scans, trained for less time."""
    with servers.running_service(SETTINGS, map_name="demo") as endpoint:
        with triquad_client.connect(endpoint, "demo") as client:
            for scan in DRIVE:
                client.publish_scan(scan.points, scan.world_from_sensor)
                client.flush(servers.WAIT_S, pending=2)
            client.flush(servers.WAIT_S)
            client.settle(servers.WAIT_S)
        yield endpoint


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs an example as ``python NAME ARGUMENTS`` does, in this process; what it prints."""

    def run_example(name: str, *arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run_example


@pytest.fixture
def ask(run: Run, endpoint: str) -> Run:
    """Runs an example that asks the server."""
    return lambda name, *arguments: run(name, "--connect", endpoint, *arguments)


def test_every_example_is_tested_and_explained() -> None:
    tests = Path(__file__).read_text(encoding="utf-8")
    guides = "".join(path.read_text(encoding="utf-8") for path in (DOCS / "guides").glob("*.md"))
    for example in EXAMPLES.glob("*.py"):
        assert f'"{example.name}"' in tests
        assert f"../examples/{example.name}" in guides


def printed_places(output: str) -> NDArray[np.float64]:
    """The rows [N, 3] of the array that an example prints."""
    rows = re.findall(r"^ ?\[+\s*(-?[\d.]+)\s+(-?[\d.]+)\s+(-?[\d.]+)\s*\]+$", output, re.M)
    return np.array(rows, np.float64)


def clearances(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """The true distances to a surface along a path [N, 3]."""
    along = np.arange(0, len(path) - 1, 0.005)
    places = [np.interp(along, np.arange(len(path)), axis) for axis in path.T]
    return SCENE.sdf(np.stack(places, axis=1))


def test_the_mesh_of_a_file_is_like_that_of_its_server(
    endpoint: str, run: Run, tmp_path: Path
) -> None:
    file, saved = tmp_path / "map.triquad", tmp_path / "corner.ply"
    low, high = (0.0, -8.0, -1.0), (10.0, 8.0, 5.0)
    with triquad_client.connect(endpoint, "demo") as client:
        client.download_map(file)
        served = client.mesh((low, high))
    output = run("mesh_of_a_file.py", file, saved, "--low", *low, "--high", *high)
    mesh = read_mesh(saved)
    assert f"{len(mesh.faces):,} faces" in output
    assert len(mesh.faces) == pytest.approx(len(served.faces), rel=0.01)
    distances = cKDTree(served.vertices).query(mesh.vertices)[0]
    assert np.quantile(distances, 0.99) < 0.005


def test_the_preview_of_a_file_is_read_without_triquad(
    endpoint: str, run: Run, tmp_path: Path
) -> None:
    file, saved = tmp_path / "map.triquad", tmp_path / "preview.glb"
    with triquad_client.connect(endpoint, "demo") as client:
        client.download_map(file)
        served = client.mesh()
    output = run("map_file_as_mcap.py", file, saved)
    assert "triquad" not in (EXAMPLES / "map_file_as_mcap.py").read_text().partition("import")[2]
    assert re.search(r"^ +1 /preview/mesh +foxglove.SceneUpdate$", output, re.M)
    preview = trimesh.load(saved, force="mesh")
    assert f"{len(preview.faces):,} faces" in output
    x, height, z = preview.vertices.T  # glTF has y up
    off_m = cKDTree(served.vertices).query(np.stack([x, -z, height], axis=1))[0]
    assert np.quantile(off_m, 0.95) < 0.3
    lowest, highest = (preview.visual.vertex_colors[height.argsort()[end]] for end in (0, -1))
    assert lowest[2] > lowest[0]  # blue below,
    assert highest[0] > highest[2]  # yellow above


def test_the_planned_path_is_free(ask: Run) -> None:
    output = ask("plan_path.py")
    path = printed_places(output)
    np.testing.assert_allclose(path[0], (2, -6.5, 1.2))
    np.testing.assert_allclose(path[-1], (24, 10.5, 1.2))
    assert "free True" in output
    assert np.quantile(clearances(path), 0.02) > RADIUS_M - 0.1
    assert clearances(path).min() > RADIUS_M / 2


def test_a_planner_does_not_begin_in_a_wall(ask: Run) -> None:
    with pytest.raises(SystemExit, match="the goal is not free: UNKNOWN"):
        ask("plan_path.py", "--goal", 18, 10.5, 1.2)


def test_paths_bend_away_from_what_blocks_the_straight_one(ask: Run) -> None:
    output = ask("optimise_path.py")
    ends = np.array([[2, -6, 1.2], [26, -6, 1.2]])
    assert clearances(ends).min() < RADIUS_M - 0.1
    rows = re.findall(r"bow (..) m: ([\d.]+) m, clearance ([\d.]+) m, (not )?free", output)
    assert len(rows) == 4
    best = re.search(r"best: bow (..) m", output)[1]
    chosen = next(row for row in rows if row[0] == best)
    assert not chosen[3]
    assert 24 < float(chosen[1]) < 26
    assert float(chosen[2]) >= RADIUS_M  # as printed, to the millimetre
    path = printed_places(output)
    assert len(path) > 5
    assert np.quantile(clearances(path), 0.02) > RADIUS_M - 0.1
    assert clearances(path).min() > RADIUS_M / 2


@pytest.mark.parametrize(
    ("arguments", "stop_m", "why"),
    [
        ([], 7.0, r"a step of \+0.1"),  # the kerb
        (["--step", "0.2"], 9.7, "the ground was not seen"),  # a house
        # A car, of whose side the map may show a part.
        (["--goal", "14", "-9", "--start", "14", "2"], 5.0, "not seen|a step"),
    ],
)
def test_a_robot_stops_where_it_cannot_stand(
    ask: Run, arguments: list[str], stop_m: float, why: str
) -> None:
    output = ask("walk.py", *arguments)
    found = re.search(r"stop after ([\d.]+) m: (.+)", output)
    assert float(found[1]) == pytest.approx(stop_m, abs=0.3)
    assert re.search(why, found[2])


def test_a_robot_goes_on_along_the_road(ask: Run) -> None:
    assert "free all along" in ask("walk.py", "--start", "2", "0", "--goal", "26", "0.5")


def read_costmap(path: Path) -> tuple[NDArray[np.int8], NDArray[np.float64], float]:
    """Costs [x, y], the corner [2] and the cell, read as map_server reads them."""
    lines = path.with_suffix(".yaml").read_text().splitlines()
    entries = dict(line.split(": ", 1) for line in lines)
    assert (entries["mode"], entries["negate"]) == ("raw", "0")
    with Image.open(path.parent / entries["image"]) as image:
        pixels = np.asarray(image)
    costs = np.where(pixels <= 100, pixels, -1).astype(np.int8)
    origin = [float(number) for number in entries["origin"].strip("[]").split(",")]
    return costs[::-1].T, np.array(origin[:2]), float(entries["resolution"])


def test_a_costmap_keeps_the_robot_off_what_it_would_touch(ask: Run, tmp_path: Path) -> None:
    output = ask("costmap.py", tmp_path / "street")
    cost, corner, cell = read_costmap(tmp_path / "street")
    assert cost.shape == (280, 160)
    assert "280 x 160 cells" in output
    np.testing.assert_allclose(corner, (0, -8))
    x, y = np.meshgrid(*[np.arange(count) for count in cost.shape], indexing="ij")
    middles = corner + (np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) * cell
    least = np.full(len(middles), np.inf)
    for height in np.arange(0.45, 1.05, 0.1):  # of the robot's balls
        balls = np.column_stack([middles, np.full(len(middles), height)])
        least = np.minimum(least, SCENE.sdf(balls))
    cost = cost.reshape(-1)
    touched = (least < 0.35 - 0.05) & (least > -0.1)
    assert ((cost[touched] >= 99) | (cost[touched] == -1)).mean() > 0.99
    clear = least > 0.35 + 0.05
    assert (cost[clear] < 99).mean() > 0.99
    road = np.abs(middles[:, 1]) < 2
    assert ((cost[road] >= 0) & (cost[road] < 50)).mean() > 0.99
    inside = least < -0.3  # of cars and houses
    assert ((cost[inside] == -1) | (cost[inside] >= 99)).mean() > 0.99
    assert (cost[inside] == -1).any()


def test_a_scan_finds_its_place(ask: Run, tmp_path: Path) -> None:
    scan = DRIVE.sensor.scan(SCENE, TRUE_POSE, np.random.default_rng(5))
    np.save(tmp_path / "scan.npy", scan.points)
    for arguments in ([], ["--scan", tmp_path / "scan.npy"]):
        output = ask("localise.py", *arguments)
        found = re.search(r"x (.+) m, y (.+) m, z (.+) m, yaw (.+) deg", output)
        x, y, z, yaw_deg = map(float, found.groups())
        np.testing.assert_allclose([x, y, z], TRUE_POSE[:3, 3], atol=0.05)
        assert abs(yaw_deg) < 0.3
        assert "\nbelieve it" in output


def test_a_scan_of_another_place_is_doubted(ask: Run, tmp_path: Path) -> None:
    np.save(tmp_path / "scan.npy", servers.sphere())
    assert "do not use it" in ask("localise.py", "--scan", tmp_path / "scan.npy")


def test_poses_that_drift_are_corrected(run: Run, tmp_path: Path) -> None:
    settings = Settings(
        store=StoreSettings(log_max_bytes=1_000_000_000), training=SETTINGS.training
    )
    with servers.running_service(settings, store=tmp_path) as endpoint:
        output = run("correct_poses.py", "--connect", endpoint)
    before_m, after_m = map(float, re.findall(r"the wall is ([\d.]+) m away", output))
    assert abs(before_m - 2.0) > 0.2
    assert abs(after_m - 2.0) < 0.05
    assert re.search(
        r"^20 scans moved, 21 learnt again; epoch \d+, the map before, is", output, re.M
    )


def test_a_second_robot_finds_its_place_and_is_corrected_alone(run: Run, tmp_path: Path) -> None:
    settings = Settings(
        store=StoreSettings(log_max_bytes=1_000_000_000), training=SETTINGS.training
    )
    with (
        servers.running_service(settings, store=tmp_path) as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        output = run("two_robots.py", "--connect", endpoint)
        trail = client.sources().sources["first"].trail
    (off_cm,) = map(float, re.findall(r"([\d.]+) cm off", output))
    assert off_cm < 5
    assert "\n14 scans of the second robot moved" in output
    np.testing.assert_allclose(trail, [(5 + x, 6, 1.5) for x in range(15)], atol=1e-6)
    (distance_m,) = map(float, re.findall(r"the wall is ([\d.]+) m away", output))
    assert abs(distance_m - 2.0) < 0.05


def test_a_scan_finds_its_place_in_a_file(endpoint: str, ask: Run, tmp_path: Path) -> None:
    with triquad_client.connect(endpoint, "demo") as client:
        client.download_map(tmp_path / "demo.triquad")
    assert "\nbelieve it" in ask("localise.py", "--file", tmp_path / "demo.triquad")


def test_a_lidar_without_poses_is_mapped_by_its_bytes(run: Run) -> None:
    with (
        servers.running_service(SETTINGS) as endpoint,
        bridging(endpoint, "--odometry", "points") as bridged,
    ):
        printed = run("lidar_without_poses.py", "--connect", endpoint)
        assert not bridged.bridge.dropped
    went_m, below_m = map(float, re.findall(r"(\d+\.\d+) m", printed))
    assert abs(went_m - 8.7) < 0.05
    assert abs(below_m - 1.5) < 0.05
