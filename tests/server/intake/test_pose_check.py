"""Scans with poses of another meaning: a client that publishes them is told, and what to do."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import hall, servers
from support.maps.drifted import SETTINGS
from triquad_client import Client, Intrinsics, Pose, RefusedError
from triquad_format.records.arrays import Doubles
from triquad_server.settings.loading import load_settings

SCANS = 36
WIDE = load_settings(servers.SMALL_FILE, ["field.depth=10"])
"""Wrong poses spread scans over a kilometre: fewer regions take less time."""
Meant = Callable[[Doubles], Doubles]
CAMERA = Intrinsics(60.0, 60.0, 39.5, 29.5)
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # a camera that looks ahead


def yaw_rad(x_m: float) -> float:
    return 0.2 + 0.1 * x_m


def way() -> list[Doubles]:
    """Poses of a robot that goes down the hall and turns all the time."""
    poses = [np.eye(4) for _ in range(SCANS)]
    for number, pose in enumerate(poses):
        pose[:3, :3] = Rotation.from_euler("z", yaw_rad(number)).as_matrix()
        pose[:3, 3] = number, 2 * np.sin(0.2 * number), 1.8
    return poses


def as_it_is(pose: Doubles) -> Doubles:
    return pose


def w_first(pose: Doubles) -> Doubles:
    """A pose of which the quaternion w x y z was taken for x y z w."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return Pose(pose[:3, 3], (w, x, y, z)).matrix()


def in_degrees(pose: Doubles) -> Doubles:
    """A pose for which the degrees of the yaw were taken for radians."""
    yaw, turned = yaw_rad(pose[0, 3]), pose.copy()
    more = Rotation.from_euler("z", np.degrees(yaw) - yaw).as_matrix()
    turned[:3, :3] = more @ pose[:3, :3]
    return turned


def never_given(_: Doubles) -> Doubles:
    return np.eye(4)


def drive_lidar(client: Client, meant: Meant, *, in_map: bool = False) -> None:
    for number, pose in enumerate(way()):
        points = hall.seen(hall.lidar_rays(), pose)
        if in_map:
            points = points @ pose[:3, :3].T + pose[:3, 3]
        client.publish_scan(points, meant(pose), 1 + 0.1 * number, source="it")
        client.flush(servers.WAIT_S, pending=4)


def drive_camera(client: Client, meant: Meant) -> None:
    rows, columns = np.indices((60, 80)).reshape(2, -1)
    rays = np.stack([(columns - 39.5) / 60, (rows - 29.5) / 60, np.ones(4800)], -1)
    for number, robot in enumerate(way()):
        pose = robot.copy()
        pose[:3, :3] = robot[:3, :3] @ OPTICAL
        depth = hall.seen(rays, pose)[:, 2].reshape(60, 80).astype(np.float32)
        client.publish_depth(depth, CAMERA, meant(pose), 1 + 0.1 * number, source="it")
        client.flush(servers.WAIT_S, pending=4)


INVERSE = "seem to be sensor_from_world: by them .* if taken so: give their inverses"
W_FIRST = "seem to have quaternions w x y z: .*: give quaternions as x y z w, with w last"
STILL = "the poses do not fit the points: by them .*: give each scan its own pose, of its time"
NOT_MOVED = "as if they were in the map frame already: .* make rotations of radians, not of degrees"


def assert_told(told: str, client: Client) -> None:
    """Nothing else is told than what matches ``told``, which is nothing where that is empty."""
    found = client.flush(servers.WAIT_S).warnings
    assert len(found) == bool(told), found
    assert re.search(told, "".join(found)), found


@pytest.mark.parametrize(
    ("drive", "meant", "told"),
    [
        (drive_lidar, as_it_is, ""),
        (drive_lidar, np.linalg.inv, INVERSE),
        (drive_camera, as_it_is, ""),
        (drive_camera, np.linalg.inv, INVERSE),
        (drive_camera, w_first, W_FIRST),
        (drive_camera, in_degrees, NOT_MOVED),
        (drive_camera, never_given, STILL),
    ],
)
def test_poses_of_another_meaning_are_told_with_the_remedy(
    drive: Callable[[Client, Meant], None], meant: Meant, told: str
) -> None:
    with servers.service_and_client(WIDE) as client:
        drive(client, meant)
        assert_told(told, client)


def test_points_in_the_map_frame_are_told_with_the_remedy() -> None:
    with servers.service_and_client(WIDE) as client:
        drive_lidar(client, as_it_is, in_map=True)
        assert_told("rays begin elsewhere: give points in the frame of the sensor", client)


def test_corrections_of_another_meaning_are_refused_and_the_map_stays(tmp_path: Path) -> None:
    with servers.service_and_client(SETTINGS, tmp_path) as client:
        drive_lidar(client, as_it_is)
        client.flush()
        stamps_s = 1 + 0.1 * np.arange(SCANS)
        trail = client.sources().sources["it"].trail
        for meant, told in ((np.linalg.inv, INVERSE), (w_first, W_FIRST)):
            with pytest.raises(RefusedError, match=f"no pose was corrected: the poses {told}"):
                client.correct_poses("it", stamps_s, [meant(pose) for pose in way()])
        np.testing.assert_array_equal(client.sources().sources["it"].trail, trail)
        assert client.correct_poses("it", stamps_s, way()).scans_moved == 0
