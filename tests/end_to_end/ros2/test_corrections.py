"""A SLAM on a robot with ROS 2 closes a loop: the scans before move with its path."""

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import servers
from support.maps.drifted import SAME, SCANS, SETTINGS, off, shared, surface, truth
from support.maps.small_world import world
from support.ros.ros_bridge import MAST, Bridged, bridging
from support.ros.ros_robot import Robot, robot, stamp
from support.ros_messages import PATH
from triquad_server.settings import Settings
from triquad_tools.ros2.intake.source_poses import Jump


def body(number: int) -> NDArray[np.float64]:
    """Where the robot truly was at a scan: its lidar is on a mast."""
    return world(SCANS).scans[number].world_from_sensor @ np.linalg.inv(MAST)


def drive(r2: Robot, numbers: Sequence[int], error: NDArray[np.float64]) -> None:
    """Take scans where the robot believes to be."""
    r2.tf(0, ("base_link", "lidar", MAST), static=True)
    for number in numbers:
        believed = body(number) @ MAST @ error @ np.linalg.inv(MAST)
        for second in (number, number + 0.5):
            r2.tf(second, ("map", "base_link", believed))
        points = world(SCANS).scans[number].points
        r2.cloud(number, points)


def send_path(r2: Robot, numbers: Sequence[int], frame: str = "map", at_s: float = 0.0) -> None:
    stamps_ns = [stamp(number + at_s) for number in numbers]
    poses = np.array([body(number) for number in numbers])
    r2.send("/slam/path", PATH, r2.messages.path(stamps_ns, poses, frame))


@contextmanager
def mapped(store: Path | None, error: NDArray[np.float64]) -> Iterator[tuple[Bridged, Robot]]:
    """A server, a bridge that is to correct poses, and a robot that has driven."""
    settings = SETTINGS if store else Settings.model_validate({"field": {"leaf_m": 0.2}})
    with (
        servers.running_service(settings, store=store) as endpoint,
        bridging(endpoint, "--corrections", "/slam/path") as bridged,
        robot(endpoint) as r2,
    ):
        drive(r2, range(4), error)
        bridged.wait_for(lambda: bridged.accounted == 4)
        assert bridged.taken == 4, bridged.bridge.dropped
        yield bridged, r2


def moved_with_the_path(log: pytest.LogCaptureFixture) -> list[int]:
    """How many scans each correction has moved so far."""
    return list(map(int, re.findall(r"points: scans moved with the path: (\d+)", log.text)))


def trail_error_m(bridged: Bridged) -> float:
    """How far the map has the scans from where they were taken, at most."""
    trail = bridged.client.sources().sources["points"].trail
    there = [scan.world_from_sensor[:3, 3] for scan in world(SCANS).scans[: len(trail)]]
    return float(np.linalg.norm(trail - there, axis=1).max())


def test_scans_move_with_the_path_and_those_that_are_right_stay(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with mapped(tmp_path / "store", off()) as (bridged, r2):
        send_path(r2, range(4))
        bridged.wait_for(lambda: moved_with_the_path(caplog) == [4])
        drive(r2, [4], np.eye(4))
        drive(r2, [5], off())
        bridged.wait_for(lambda: bridged.taken == SCANS)
        send_path(r2, range(SCANS))
        bridged.wait_for(lambda: moved_with_the_path(caplog) == [4, 1])
        assert trail_error_m(bridged) < 1e-3
        bridged.client.flush()
        assert shared(surface(bridged.client, tmp_path), truth()) > SAME


def test_scans_after_the_last_keyframe_move_with_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with mapped(tmp_path / "store", off()) as (bridged, r2):
        send_path(r2, (0, 1))
        bridged.wait_for(lambda: moved_with_the_path(caplog) == [4])
        assert trail_error_m(bridged) < 1e-3


@pytest.mark.parametrize(
    ("store", "frame", "at_s", "told"),
    [
        (None, "map", 0.0, "start the server with --store, and store.log_max_bytes above 0"),
        (
            "store",
            "odom",
            0.0,
            "the path is in 'odom', and the map is made in 'map': .*--map-frame",
        ),
        ("store", "map", 1e6, "no scan came then: its poses need the stamps of the scans"),
    ],
)
def test_a_path_by_which_nothing_can_be_corrected_is_told(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    store: str | None,
    frame: str,
    at_s: float,
    told: str,
) -> None:
    with mapped(store and tmp_path / store, off()) as (bridged, r2):
        send_path(r2, range(4), frame, at_s)
        bridged.wait_for(lambda: "no pose was corrected" in caplog.text)
        assert re.search(told, caplog.text), caplog.text
        assert bridged.taken == 4


def test_scans_before_a_jump_of_odometry_move_with_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    bodies = [body(number) for number in range(SCANS)]
    place = np.eye(4)
    place[:3, 3] = bodies[4][:3, 3]
    jump = Jump(0, place @ off() @ np.linalg.inv(place))
    shares = np.minimum(np.arange(SCANS) / 4, 1.0)
    adrift = np.linalg.inv(jump.parts(shares, place[:3, 3])) @ bodies
    with (
        servers.running_service(SETTINGS, store=tmp_path / "store") as endpoint,
        bridging(endpoint, "--corrections", "tf", "--wait-s", "1") as bridged,
        robot(endpoint) as r2,
    ):
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        for number, pose in enumerate(adrift):
            map_from_odom = np.eye(4) if number < 5 else jump.move
            for second in (number, number + 0.5):
                r2.tf(second, ("map", "odom", map_from_odom), ("odom", "base_link", pose))
            r2.cloud(number, world(SCANS).scans[number].points)
        bridged.wait_for(lambda: bridged.taken == SCANS)
        bridged.wait_for(lambda: len(moved_with_the_path(caplog)) > 0)
        assert trail_error_m(bridged) < 0.02
        bridged.client.flush()
        assert shared(surface(bridged.client, tmp_path), truth()) > SAME
