import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.maps.exact_view import ExactView
from support.maps.small_world import settled_epoch, world
from triquad_map.questions.align import Alignment, align
from triquad_server.settings import Settings, TrainingSettings
from triquad_tools.recordings.cloud import points_in_range
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box, cylinder, half_space

from bench.street import settled_mapper

SEOSAN = Path(__file__).resolve().parents[4] / "shared" / "data" / "seosan01"
LIDAR = Lidar(beams=32, columns=360)
FAR = np.full(3, 1e4)
REACH_M = 6.0
BOUNDS = np.array([[-40.0, -40.0, -1.0], [40.0, 40.0, 10.0]])


def scene(*solids: Solid) -> Scene:
    return Scene((half_space(0.0), *solids), BOUNDS)


def wall(x: float, y: float, half_x: float, half_y: float, yaw: float = 0.0) -> Solid:
    return box((x, y, 2.0), (half_x, half_y, 4.0), yaw)


YARD = scene(
    wall(12.0, 3.0, 1.0, 9.0),
    wall(-4.0, 11.0, 8.0, 1.0, 0.2),
    wall(-14.0, -2.0, 2.0, 3.0),
    wall(3.0, -9.0, 4.0, 1.5, -0.4),
    cylinder((5.0, 6.0, 2.0), 0.2, 3.0),
)
PLAIN = scene()
CORRIDOR = scene(wall(0.0, 3.0, 500.0, 0.5), wall(0.0, -3.0, 500.0, 0.5))


def yawed(angle: float, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = x, y, z
    return pose


TRUE = yawed(0.3, 1.0, -0.5, 1.7)


def view_of(what: Scene, map_from_scene: NDArray[np.float64] | None = None) -> ExactView:
    return ExactView(what, np.eye(4) if map_from_scene is None else map_from_scene, -FAR, FAR)


def scan_of(what: Scene, pose: NDArray[np.float64] = TRUE) -> NDArray[np.float64]:
    return LIDAR.scan(what, pose, np.random.default_rng(1)).points.astype(np.float64)


def displaced(
    pose: NDArray[np.float64], metres: float, degrees: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A pose [4, 4] moved in a random direction, and turned about a random axis of its own."""
    shift, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += metres * shift
    return moved


def guessed(metres: float, degrees: float, seed: int = 0) -> NDArray[np.float64]:
    return displaced(TRUE, metres, degrees, np.random.default_rng(seed))


def rotation_error(found: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """The small rotation vector from what was found to what is true, map frame."""
    turn = true[:3, :3] @ found[:3, :3].T
    return np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2


def error_of(alignment: Alignment, true: NDArray[np.float64] = TRUE) -> NDArray[np.float64]:
    """Error [6] as the covariance counts it."""
    found = alignment.world_from_sensor
    return np.concatenate([true[:3, 3] - found[:3, 3], rotation_error(found, true)])


@hypothesis_settings(max_examples=8)
@given(st.integers(0, 2**31), st.floats(0.0, 1.0), st.floats(0.0, 10.0))
def test_a_scan_is_put_back_to_where_it_was_taken(seed: int, metres: float, degrees: float) -> None:
    found = align(view_of(YARD), scan_of(YARD), guessed(metres, degrees, seed), REACH_M)
    error = error_of(found)
    assert found.converged
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.degrees(np.linalg.norm(error[3:])) < 0.1
    assert found.inlier_share > 0.95
    assert found.rms_m < 0.02
    assert found.epoch == 7
    assert 1000 < found.points < 2300
    # As sure as it says, give or take.
    assert error @ np.linalg.solve(found.covariance, error) / 6 < 9
    assert np.sqrt(np.diag(found.covariance)[:3]).max() < 0.05


def test_on_a_plain_only_height_and_tilt_are_found() -> None:
    guess = guessed(0.3, 3.0)
    found = align(view_of(PLAIN), scan_of(PLAIN), guess, REACH_M)
    deviation = np.sqrt(np.diag(found.covariance))
    assert not found.converged
    assert deviation[[0, 1]].min() > 50
    assert deviation[5] > 1
    assert deviation[2] < 0.05
    assert deviation[[3, 4]].max() < 0.01
    moved = found.world_from_sensor[:3, 3] - guess[:3, 3]
    assert np.abs(moved[:2]).max() < 1e-3
    error = error_of(found)
    assert abs(error[2]) < 0.01
    assert np.abs(error[3:5]).max() < 0.002


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_along_a_corridor_the_guess_is_kept_and_the_variance_says_so(angle: float) -> None:
    turn = yawed(angle, 20.0, -7.0, 1.0)
    true, guess = turn @ TRUE, turn @ guessed(0.4, 4.0)
    found = align(view_of(CORRIDOR, turn), scan_of(CORRIDOR), guess, REACH_M)
    along, across, up = turn[:3, :3].T
    position = found.covariance[:3, :3]
    assert not found.converged
    assert np.sqrt(along @ position @ along) > 50
    assert np.sqrt(across @ position @ across) < 0.05
    assert np.sqrt(up @ position @ up) < 0.05
    error = error_of(found, true)
    assert abs(error[:3] @ across) < 0.01
    assert abs(error[:3] @ up) < 0.01
    assert np.linalg.norm(error[3:]) < 0.002
    moved = found.world_from_sensor[:3, 3] - guess[:3, 3]
    assert abs(moved @ along) < 0.05


def test_nothing_is_found_in_unknown_space() -> None:
    unseen = ExactView(YARD, np.eye(4), FAR, FAR + 1)
    guess = guessed(0.5, 5.0)
    found = align(unseen, scan_of(YARD), guess, REACH_M)
    assert not found.converged
    assert found.inlier_share == 0
    np.testing.assert_allclose(found.world_from_sensor, guess, atol=1e-12)
    assert np.sqrt(np.diag(found.covariance)[:3]).min() >= 100


def test_a_scan_that_sees_beyond_the_map_is_aligned_by_what_the_map_has_seen() -> None:
    corner = dataclasses.replace(
        view_of(YARD), seen_low=np.array([-1.0, -50.0, -5.0]), seen_high=np.array([50.0, 50.0, 9.0])
    )
    whole = scan_of(YARD)
    assert ((whole @ TRUE[:3, :3].T + TRUE[:3, 3])[:, 0] < -1.0).mean() > 0.3
    found = align(corner, whole, guessed(0.5, 5.0), 2.0)
    assert found.converged
    assert np.linalg.norm(error_of(found)[:3]) < 0.02


def test_far_from_where_it_was_taken_a_scan_does_not_pass_for_aligned() -> None:
    guess = yawed(2.0, -6.0, 4.0, 1.7)
    found = align(view_of(YARD), scan_of(YARD), guess, REACH_M)
    assert np.linalg.norm(error_of(found)[:3]) > 1.0
    assert not found.converged


@pytest.mark.parametrize("count", [0, 3, 40])
def test_a_few_points_are_not_enough(count: int) -> None:
    found = align(view_of(YARD), scan_of(YARD)[:count], TRUE, REACH_M)
    assert not found.converged
    assert found.points == count
    assert np.isfinite(found.covariance).all()


def test_it_does_not_matter_where_the_map_lies() -> None:
    moved = displaced(yawed(2.5, 300.0, -80.0, 20.0), 5.0, 20.0, np.random.default_rng(2))
    guess = guessed(0.5, 5.0)
    here = align(view_of(YARD), scan_of(YARD), guess, REACH_M)
    there = align(view_of(YARD, moved), scan_of(YARD), moved @ guess, REACH_M)
    np.testing.assert_allclose(
        there.world_from_sensor, moved @ here.world_from_sensor, rtol=0, atol=1e-4
    )
    turn = np.kron(np.eye(2), moved[:3, :3])
    expected = turn @ here.covariance @ turn.T
    np.testing.assert_allclose(
        there.covariance, expected, rtol=0, atol=0.01 * np.abs(expected).max()
    )
    assert there.converged == here.converged


def test_points_that_are_not_finite_are_left_out() -> None:
    points = scan_of(YARD)
    holes = np.insert(points, [0, 500, len(points)], np.nan, axis=0)
    found = align(view_of(YARD), holes, guessed(0.5, 5.0), REACH_M)
    expected = align(view_of(YARD), points, guessed(0.5, 5.0), REACH_M)
    np.testing.assert_array_equal(found.world_from_sensor, expected.world_from_sensor)


def test_iterations_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triquad_map.questions.align.MAX_ITERATIONS", 2)
    found = align(view_of(YARD), scan_of(YARD), guessed(0.5, 5.0), REACH_M)
    assert found.iterations == 2
    assert not found.converged


@pytest.mark.parametrize(
    "guess",
    [np.eye(3), 2 * np.eye(4), np.full((4, 4), np.nan), np.diag([1.0, 1.0, -1.0, 1.0]), 0.0],
)
def test_a_guess_that_is_no_pose_is_refused(guess: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match="not a rotation and a translation"):
        align(view_of(YARD), scan_of(YARD), guess, REACH_M)


def test_points_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(5, 4\)"):
        align(view_of(YARD), np.zeros((5, 4)), TRUE, REACH_M)


def test_a_scan_is_put_back_into_a_map_that_was_learnt() -> None:
    drive = world(4)
    epoch = settled_epoch(4)
    rng = np.random.default_rng(5)
    middle = drive.scans[2].world_from_sensor
    for _ in range(5):
        true = displaced(middle, 0.3, 2.0, rng)
        points = Lidar(columns=360).scan(drive.scene, true, rng).points.astype(np.float64)
        found = align(epoch, points, displaced(true, 0.5, 5.0, rng), REACH_M)
        error = error_of(found, true)
        assert found.converged
        assert np.linalg.norm(error[:3]) < 0.05
        assert np.degrees(np.linalg.norm(error[3:])) < 0.5


@pytest.mark.long
def test_withheld_real_scans_are_put_back() -> None:
    if not SEOSAN.is_dir():
        pytest.skip("real scans seosan01 are not in ../shared/data")
    soon = Settings(training=TrainingSettings(samples_per_ray=10.0))  # a fifth: enough for this
    scans, rng = list(read_cloud_folder(SEOSAN).read(range(14))), np.random.default_rng(4)
    outside = [PosedScan(points_in_range(s.points, 2.0), s.world_from_sensor) for s in scans]
    mapped = [scan for number, scan in enumerate(outside) if number % 7 != 6]
    view = settled_mapper("seosan01", mapped, soon).publish()
    good = []
    for scan in [scan for scan in outside[6::7] for _ in range(10)]:
        true = scan.world_from_sensor
        points = np.asarray(scan.points, np.float64)
        found = align(view, points, displaced(true, 0.5, 5.0, rng), REACH_M)
        error = error_of(found, true)
        near = np.linalg.norm(error[:3]) < 0.05 and np.linalg.norm(error[3:]) < np.radians(0.5)
        good.append(found.converged and near)
    assert len(good) == 20
    assert np.mean(good) >= 0.95
