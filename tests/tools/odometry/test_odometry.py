"""A lidar that comes back to a place, or that nothing holds along its way."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from support.poses import shifted
from triquad_client import Pose
from triquad_tools.commands.ros2 import parser
from triquad_tools.odometry.way import Way
from triquad_tools.recordings.odometry import find_trajectory
from triquad_tools.ros2.intake.corrections import BodyPath
from triquad_tools.ros2.intake.live_odometry import LiveOdometry
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.track import Transform
from triquad_tools.sensors.reach import reach_m
from triquad_tools.sensors.sweep import NoScanError, PosedScan, Sweep
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box, half_space
from triquad_tools.work.ros2 import bridge_options

from bench.scenes.block import block_drive
from bench.scenes.room import room_by_lidar

LIDAR = Lidar(beams=16, columns=720, noise_m=0.02)
PERIOD_NS = 10**8


@cache
def around() -> tuple[Sequence[PosedScan], NDArray[np.float64]]:
    """A drive around a small block, and 10 m on, with a lidar of few beams."""
    drive = block_drive(41, 44.0, 266, 0.7, LIDAR)
    return list(drive), drive.poses


def followed(scans: Sequence[PosedScan], *, close_loops: bool = True) -> Way:
    sweeps = [Sweep(scan.points, "lidar", n * PERIOD_NS) for n, scan in enumerate(scans)]
    way = Way(reach_m([sweep.points for sweep in sweeps[:8]]), close_loops=close_loops)
    for sweep in sweeps:
        way.add(sweep)
    return way


def off_m(way: Way, true: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far the poses that were found lie from the true ones, both as seen from the first."""
    found = way.trajectory()[1]
    there = np.linalg.inv(true[0]) @ true
    return np.linalg.norm(found[:, :3, 3] - there[:, :3, 3], axis=1)


def test_a_loop_takes_the_drift_out() -> None:
    scans, true = around()
    adrift, closed = (followed(scans, close_loops=loops) for loops in (False, True))
    assert adrift.loops == 0 < closed.loops
    assert off_m(closed, true)[-15:].max() < 0.1
    assert off_m(closed, true).mean() < off_m(adrift, true).mean()
    assert closed.moved_m > 0.5 * off_m(adrift, true)[-1]


def test_a_way_goes_on_where_nothing_holds_it() -> None:
    shell = [box((60.0, y, 1.5), (30.0, 0.2, 1.5)) for y in (-2.2, 2.2)]
    shell += [box((60.0, 0.0, z), (30.0, 3.0, 0.2)) for z in (-0.2, 3.2)]
    front = [
        box((x, 3.0 * side, 1.0), (0.4, 0.3, 1.0)) for x in range(0, 30, 3) for side in (-1, 1)
    ]
    ground = [half_space(-0.4)]
    tunnel = Scene((*shell, *front, *ground), np.array([[-9.0, -9, -1], [99.0, 9, 9]]))
    poses = np.tile(np.eye(4), (45, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = 5.0 + np.arange(45), 1.5
    scans = list(SimulatedDrive(tunnel, Lidar(beams=32, columns=512, range_max_m=12.0), poses))
    way = followed(scans)
    assert way.loose
    assert off_m(way, poses).max() < 3.0


def test_a_scan_of_another_place_is_left_out() -> None:
    scans, _ = around()
    way = followed(scans[:6])
    with pytest.raises(NoScanError, match=r"\d+% of its points lie where"):
        way.add(Sweep(scans[100].points, "lidar", 6 * PERIOD_NS))
    way.add(Sweep(scans[6].points, "lidar", 6 * PERIOD_NS))
    assert len(way.trajectory()[1]) == 7


def test_clouds_without_points_do_not_say_how_far_it_sees() -> None:
    drive = room_by_lidar(12, 24)
    clouds = [np.full((9, 3), np.nan)] * 12 + [scan.points[::2] for scan in drive]
    sweeps = [Sweep(points, "lidar", number * PERIOD_NS) for number, points in enumerate(clouds)]
    there = (np.linalg.inv(drive.poses[0]) @ drive.poses)[:, :3, 3]
    found = find_trajectory(sweeps, len(sweeps)).poses[-len(drive) :, :3, 3]
    assert np.abs(found - there).max() < 0.05
    moved = followed_live(sweeps, FrameTree(), "lidar")
    assert np.abs(moved - there).max() < 0.05


def test_what_sits_still_on_a_robot_may_be_published_late_with_all_that_moves() -> None:
    scans, true = around()
    sweeps = [Sweep(scan.points, "lidar", n * PERIOD_NS) for n, scan in enumerate(scans[:14])]
    frames = FrameTree()
    mast = Pose((0.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    for stamp_ns in (PERIOD_NS // 2, 8 * PERIOD_NS):
        frames.add(Transform("base_link", "lidar", stamp_ns, mast))
    moved = followed_live(sweeps, frames, "base_link")
    there = np.linalg.inv(true[0]) @ true[:14] @ shifted(z=-0.5)
    assert np.abs(moved - there[:, :3, 3]).max() < 0.1


def test_the_times_of_a_path_rise_whatever_stamps_came() -> None:
    sweeps = [Sweep(scan.points, "lidar", n * PERIOD_NS) for n, scan in enumerate(around()[0])]
    for number in range(20, 160, 11):
        sweeps[number] = replace(sweeps[number], stamp_ns=sweeps[number].stamp_ns + 10**12)
    options = bridge_options(parser().parse_args(["--odometry", "/points"]))
    live = LiveOdometry("/points", FrameTree(), options, "map")
    found = [found for sweep in sweeps for found in live.take(sweep)]
    paths = [one for one in found if isinstance(one, BodyPath)]
    assert paths
    assert all((np.diff(path.stamps_ns) > 0).all() for path in paths)


def followed_live(sweeps: list[Sweep], frames: FrameTree, body: str) -> NDArray[np.float64]:
    """The places [N, 3] of a robot's body, as they are found while sweeps come."""
    options = bridge_options(parser().parse_args(["--odometry", "/points", "--body-frame", body]))
    live = LiveOdometry("/points", frames, options, "map")
    found = [found for sweep in sweeps for found in live.take(sweep)]
    moves = [one for one in found if isinstance(one, Transform) and one.child == body]
    assert live.body_frame == body
    return np.array([move.pose.position_m for move in moves])
