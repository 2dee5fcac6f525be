"""What a loop is off is spread over the way between its ends."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from triquad_tools.odometry.pose_chain import Loop, closed, is_news, surprise

Poses = NDArray[np.float64]


def moves(turns: NDArray[np.float64], shifts: NDArray[np.float64]) -> Poses:
    made = np.tile(np.eye(4), (len(turns), 1, 1))
    made[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    made[:, :3, 3] = shifts
    return made


def chained(first: NDArray[np.float64], steps: Poses) -> Poses:
    poses = [first]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def circle(count: int = 120, radius_m: float = 20.0) -> Poses:
    """A way around a circle and a little on, far from the origin of the map."""
    angles = np.linspace(0, 2.2 * np.pi, count)
    zeros = np.zeros(count)
    turns = np.column_stack([zeros, zeros, angles + np.pi / 2])
    places = radius_m * np.column_stack([np.cos(angles), np.sin(angles), zeros])
    return moves(turns, places + [300.0, -200.0, 10.0])


def adrift(true: Poses, seed: int, turn_deg: float = 0.1, shift_m: float = 0.01) -> Poses:
    """The same way as an odometry has it whose steps are off at random."""
    rng = np.random.default_rng(seed)
    steps = np.linalg.inv(true[:-1]) @ true[1:]
    turns = np.radians(turn_deg) * rng.normal(size=(len(steps), 3))
    return chained(true[0], steps @ moves(turns, shift_m * rng.normal(size=(len(steps), 3))))


def loop(true: Poses, before: int, after: int) -> Loop:
    return Loop(before, after, np.linalg.inv(true[before]) @ true[after])


def off_m(poses: Poses, true: Poses) -> NDArray[np.float64]:
    return np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_loops_bring_the_way_back(seed: int) -> None:
    true = circle()
    drifted = adrift(true, seed)
    loops = [loop(true, back, 109 + back) for back in range(0, 10, 3)]
    better = closed(drifted, loops)
    np.testing.assert_array_equal(better[0], true[0])
    assert off_m(better, true)[109:].max() < 0.1 < off_m(drifted, true)[109:].max()
    assert off_m(better, true).mean() < off_m(drifted, true).mean()
    turned = np.linalg.det(better[:, :3, :3])
    np.testing.assert_allclose(turned, 1.0, atol=1e-9)


def test_a_way_that_is_right_stays() -> None:
    true = circle()
    loops = [loop(true, 0, 109), loop(true, 5, 114)]
    np.testing.assert_allclose(closed(true, loops), true, atol=1e-9)
    assert not is_news(true, loops[0])
    assert surprise(true, loops[0]) < 1e-6


def test_what_lies_within_no_loop_moves_as_a_whole() -> None:
    true = circle()
    drifted = adrift(true, 7)
    better = closed(drifted, [loop(true, 30, 100)])
    np.testing.assert_allclose(better[:31], drifted[:31], atol=1e-12)
    steps, before = (np.linalg.inv(poses[100:-1]) @ poses[101:] for poses in (better, drifted))
    np.testing.assert_allclose(steps, before, atol=1e-9)


def test_a_loop_that_contradicts_many_counts_little() -> None:
    true = circle()
    drifted = adrift(true, 3)
    loops = [loop(true, back, 109 + back) for back in range(0, 10, 2)]
    wrong = Loop(4, 113, loops[2].before_from_after @ moves(np.zeros((1, 3)), np.eye(3)[:1] * 4)[0])
    assert off_m(closed(drifted, [*loops, wrong]), true)[109:].max() < 0.15


def test_another_floor_surprises_and_drift_does_not() -> None:
    true = circle()
    drifted = adrift(true, 1, turn_deg=0.05)
    right = loop(true, 0, 109)
    assert is_news(drifted, right)
    assert surprise(drifted, right) < 10
    above = right.before_from_after.copy()
    above[2, 3] += 8.0
    assert surprise(drifted, Loop(0, 109, above)) > 10
