"""Lidars whose poses nobody gives: they are found by the clouds, or given for a bag."""

import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.recordings.bags import Recorded, messages_for, write_bag
from support.recordings.kitti_folder import write_folder
from support.recordings.point_files import columns, write_ply
from support.recordings.trajectories import write_tum
from support.ros_messages import CLOUD
from triquad_client import Pose
from triquad_format.records.pose import quaternion_of
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.opening import Recording, open_recording
from triquad_tools.recordings.recording import ReadingOptions
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box
from triquad_tools.simulation.street import street

BY_CLOUDS = ReadingOptions(odometry=True)
T0, PERIOD_NS = 1_700_000_000 * 10**9, 10**8


@cache
def driven(scans: int, step_m: float) -> SimulatedDrive:
    """A drive along a street; its scans are made when they are asked for."""
    scene = street(3, 60.0)
    return SimulatedDrive(scene, Lidar(beams=32, columns=512), drive(scene, scans, step_m), seed=1)


def poses_of(recording: Recording) -> NDArray[np.float64]:
    scans = recording.read(range(len(recording.entries)))
    return np.array([scan.world_from_sensor for scan in scans])


def farthest_m(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """How far poses [N, 4, 4] lie from the true ones at most, both as seen from the first."""
    here, there = (np.linalg.inv(each[0]) @ each for each in (poses, truth))
    return float(np.linalg.norm(here[:, :3, 3] - there[:, :3, 3], axis=1).max())


def clouds_only(folder: Path, scans: Sequence[NDArray[np.float32]]) -> Path:
    write_folder(folder, scans, np.zeros((0, 4, 4)), [])
    (folder / "poses.txt").unlink()
    (folder / "times.txt").unlink()
    return folder


def recorded(
    scans: Sequence[NDArray[np.float32]], **more: list[NDArray[np.float32]]
) -> list[Recorded]:
    """Clouds in a bag, ten a second, and nothing else."""
    ros, messages = messages_for("mcap"), []
    for number, points in enumerate(scans):
        stamp_ns = T0 + number * PERIOD_NS
        fields = {name: values[number] for name, values in more.items()}
        messages.append(
            Recorded("/points", CLOUD, stamp_ns, ros.cloud(points, stamp_ns, more=fields))
        )
    return messages


def test_a_folder_of_clouds_alone_is_placed(tmp_path: Path) -> None:
    drive = driven(12, 0.5)
    folder = clouds_only(tmp_path, [scan.points for scan in drive])
    with pytest.raises(ToolError, match="holds no trajectory.* found by --odometry"):
        open_recording(folder, ReadingOptions())
    recording = open_recording(folder, BY_CLOUDS)
    assert len(recording.entries) == len(drive)
    assert farthest_m(poses_of(recording), drive.poses) < 0.05
    assert recording.remarks[0].startswith("poses are those of odometry, along 5.")


def test_the_motion_during_sweeps_is_taken_out(tmp_path: Path) -> None:
    parts = 8
    fine = driven(12 * parts, 1.0 / parts)
    scans, times = [], []
    for first in range(0, len(fine), parts):
        slices = [fine.scan(first + part).points for part in range(parts)]
        slices = [points[_part_of(points, parts) == part] for part, points in enumerate(slices)]
        scans.append(np.concatenate(slices))
        seconds = [np.full(len(each), 0.1 * part / parts) for part, each in enumerate(slices)]
        times.append(np.concatenate(seconds).astype(np.float32))
    bag = write_bag(tmp_path / "bag", "mcap", recorded(scans, time=times))
    recording = open_recording(bag, BY_CLOUDS)
    assert len(recording.entries) == len(scans)
    errors_m = []
    for scan in recording.read(range(6, len(scans))):
        world = fine.poses[parts - 1] @ scan.world_from_sensor
        points = scan.points @ world[:3, :3].T + world[:3, 3]
        errors_m.append(float(np.median(np.abs(fine.scene.sdf(points)))))
    assert max(errors_m) < 0.1


def _part_of(points: NDArray[np.float32], parts: int) -> NDArray[np.int64]:
    return np.minimum((_turn(points) * parts).astype(np.int64), parts - 1)


def _turn(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far a lidar has turned when it measures points [N, 3], from 0 to 1."""
    turn: NDArray[np.float32] = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) % 1.0
    return turn


def test_clouds_that_are_free_of_motion_stay_so(tmp_path: Path) -> None:
    drive = driven(12, 1.0)
    for number, scan in enumerate(drive):
        times = (0.1 * _turn(scan.points)).astype(np.float32)
        write_ply(tmp_path / f"{number:06d}.ply", columns(scan.points, time=times))
    recording = open_recording(tmp_path, ReadingOptions(odometry=True, deskew=False))
    assert farthest_m(poses_of(recording), drive.poses) < 0.05
    for read, scan in zip(recording.read(range(12)), drive, strict=True):
        np.testing.assert_array_equal(read.points, scan.points)


def test_scans_that_do_not_fit_those_before_are_refused(tmp_path: Path) -> None:
    folder = clouds_only(tmp_path, [scan.points for scan in driven(6, 8.0)])
    with pytest.raises(
        ToolError, match=r"lost its way at scan \d: \d+% of its points .*give its poses"
    ):
        open_recording(folder, BY_CLOUDS)


def test_a_way_that_nothing_holds_is_told(tmp_path: Path) -> None:
    shell = [box((50.0, y, 1.5), (50.0, 0.2, 1.5)) for y in (-2.2, 2.2)]
    shell += [box((50.0, 0.0, z), (50.0, 3.0, 0.2)) for z in (-0.2, 3.2)]
    tunnel = Scene(tuple(shell), (np.array([-1.0, -3, -1]), np.array([101.0, 3, 4])))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = [(30.0 + 0.5 * number, 0.0, 1.5) for number in range(5)]
    scans = SimulatedDrive(tunnel, Lidar(beams=32, columns=512), poses)
    folder = clouds_only(tmp_path, [scan.points for scan in scans])
    assert (
        "4 of 5 scans, from number 2 on, see hardly" in open_recording(folder, BY_CLOUDS).remarks[1]
    )


def test_a_trajectory_places_the_clouds_of_a_bag(tmp_path: Path) -> None:
    drive = driven(6, 0.5)
    bag = write_bag(tmp_path / "bag", "mcap", recorded([scan.points for scan in drive]))
    times = [T0 + number * PERIOD_NS for number in range(len(drive))]
    write_tum(tmp_path / "slam.tum", times, [_pose(each) for each in drive.poses])
    recording = open_recording(bag, ReadingOptions(trajectory=tmp_path / "slam.tum"))
    np.testing.assert_allclose(poses_of(recording), drive.poses, atol=1e-6)
    assert [entry.stamp_ns for entry in recording.entries] == times


def _pose(matrix: NDArray[np.float64]) -> Pose:
    return Pose(tuple(matrix[:3, 3].tolist()), tuple(quaternion_of(matrix[:3, :3]).tolist()))


def test_what_odometry_needs_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = driven(6, 0.5).scan(0).points
    both = recorded([points]) + [each._replace(topic="/rear") for each in recorded([points])]
    bag = write_bag(tmp_path / "bag", "mcap", both)
    with pytest.raises(ToolError, match="clouds of one lidar, and there is /points, /rear"):
        open_recording(bag, BY_CLOUDS)
    with pytest.raises(ToolError, match="--trajectory and --poses mean nothing"):
        open_recording(bag, ReadingOptions(odometry=True, poses="tf"))
    with pytest.raises(ToolError, match="not --points-in world"):
        open_recording(bag, ReadingOptions(odometry=True, points_in="world"))
    nowhere = tmp_path / "nowhere.tum"
    with pytest.raises(ToolError, match="leave one out"):
        open_recording(bag, ReadingOptions(trajectory=nowhere, poses="tf"))
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(ToolError, match=r"pip install 'triquad\[tools\]'"):
        open_recording(bag, ReadingOptions(odometry=True, topics=("/points",)))
