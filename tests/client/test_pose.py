"""Poses as a position and a quaternion."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import servers
from triquad_client import InvalidScanError, Pose, Status

numbers = st.floats(-1, 1)


@given(quaternion=st.tuples(numbers, numbers, numbers, numbers), angle=st.floats(-3, 3))
def test_it_turns_as_the_axis_and_the_angle_say(
    quaternion: tuple[float, ...], angle: float
) -> None:
    axis = np.array(quaternion[:3])
    if np.linalg.norm(axis) < 1e-3:
        axis = np.array([0.0, 0, 1])
    axis /= np.linalg.norm(axis)
    pose = Pose((1.0, 2.0, 3.0), (*np.sin(angle / 2) * axis, np.cos(angle / 2))).matrix()
    # Rodrigues' formula.
    cross = np.cross(np.eye(3), axis)
    expected = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    np.testing.assert_allclose(pose[:3, :3], expected, atol=1e-12)
    np.testing.assert_array_equal(pose[:, 3], [1, 2, 3, 1])


def test_a_quaternion_of_few_digits_is_still_a_rotation() -> None:
    rotation = Pose((0, 0, 0), (0.0, 0.0, 0.707, 0.707)).matrix()[:3, :3]
    np.testing.assert_allclose(rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_a_scan_and_a_question_take_it() -> None:
    pose = Pose((10.0, 0, 0), (0, 0, np.sqrt(0.5), np.sqrt(0.5)))  # a quarter turn to the left
    with servers.service_and_client() as client:
        client.publish_scan(servers.sphere(), pose)
        far = [[6.0, 0, 0], [6.0, 0.1, 0], [6.0, 0, 0.1]]
        client.publish_scan(far, pose, source="far")
        client.settle(servers.WAIT_S)
        assert client.query_sdf([[10.0, 6.0, 0]]).status[0] == Status.SURFACE
        assert client.align(servers.sphere(500), pose).world_from_sensor.shape == (4, 4)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (Pose((0, 0), (0, 0, 0, 1)), "position_m is \\[2\\], not \\[3\\]"),
        (Pose((0, 0, np.nan), (0, 0, 0, 1)), "position_m = .*not finite"),
        (Pose((0, 0, 0), (0, 0, 0)), "quaternion_xyzw is \\[3\\], not \\[4\\]"),
        (Pose((0, 0, 0), (0, 0, 0, 0)), "has the length 0, not 1"),
        (Pose((0, 0, 0), (0, 0, 1, 1)), "has the length 1.414, not 1"),
        (Pose((0, 0, 0), "none"), "quaternion_xyzw = 'none' are not 4 numbers"),
        (Pose((0, 0, 10**400), (0, 0, 0, 1)), "position_m = .* are not 3 numbers"),
    ],
)
def test_what_is_no_pose_is_refused(pose: Pose, words: str) -> None:
    with pytest.raises(InvalidScanError, match=words):
        pose.matrix()
