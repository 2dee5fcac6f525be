import re
from pathlib import Path

import numpy as np
import pytest
from support.recordings.point_files import columns, write_las, write_pcd, write_ply
from support.recordings.trajectories import drive, matrices, write_log, write_tum
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders import cloud_folder
from triquad_tools.recordings.folders.cloud_folder import is_cloud_folder
from triquad_tools.recordings.folders.scan_folder import ScanFolder
from triquad_tools.recordings.recording import ReadingOptions

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
COUNT = 6
POSES = drive(COUNT, step_m=4.0)
STAMPS = [START_NS + STEP_NS * number for number in range(COUNT)]
CLOUDS = [
    np.random.default_rng(i).normal(0, 5, (50 + i, 3)).astype(np.float32) for i in range(COUNT)
]


def read_cloud_folder(folder: Path, **options) -> ScanFolder:
    return cloud_folder.read_cloud_folder(folder, ReadingOptions(**options))


def _name(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _timed(folder: Path, stamps=tuple(STAMPS), under: str = "clouds", suffix: str = ".ply") -> Path:
    (folder / under).mkdir(parents=True, exist_ok=True)
    write_tum(folder / "trajectory.txt", STAMPS, POSES)
    for stamp, cloud in zip(stamps, CLOUDS, strict=False):
        write_ply(folder / under / f"{_name(stamp)}{suffix}", columns(cloud))
    return folder


def _counted(folder: Path, count: int = COUNT) -> Path:
    folder.mkdir(exist_ok=True)
    for number in range(count):
        write_ply(folder / f"{number}.ply", columns(CLOUDS[number % COUNT]))
    return folder


def _world_las(folder: Path, poses, suffix: str = ".las") -> Path:
    folder.mkdir(exist_ok=True)
    for number, (cloud, pose) in enumerate(zip(CLOUDS, matrices(poses), strict=True)):
        write_las(folder / f"{number}{suffix}", cloud @ pose[:3, :3].T + pose[:3, 3])
    write_tum(folder / "poses.txt", STAMPS, poses)
    return folder


def test_clouds_and_poses_are_matched_by_time(tmp_path):
    recording = read_cloud_folder(_timed(tmp_path))
    assert is_cloud_folder(tmp_path)
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    assert {entry.source for entry in recording.entries} == {"default"}
    assert not recording.remarks
    assert [(s.name, s.kind, s.count) for s in recording.streams] == [
        ("clouds/*.ply", "PLY clouds", COUNT),
        ("trajectory.txt", "TUM trajectory", COUNT),
    ]
    for scan, cloud, pose in zip(recording.read(range(6)), CLOUDS, matrices(POSES), strict=True):
        np.testing.assert_array_equal(scan.points, cloud)
        assert scan.points.dtype == np.float32
        np.testing.assert_allclose(scan.world_from_sensor, pose, atol=1e-9)
    (last,) = recording.read([5])
    np.testing.assert_array_equal(last.points, CLOUDS[5])


@pytest.mark.parametrize("suffix", [".pcd", ".laz", ".PLY"])
def test_every_format_is_read(tmp_path, suffix):
    write_tum(tmp_path / "groundtruth.txt", STAMPS, POSES)
    for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
        path = tmp_path / f"{_name(stamp)}{suffix}"
        if suffix == ".pcd":
            write_pcd(path, columns(cloud))
        elif suffix in (".las", ".laz"):
            write_las(path, cloud)
        else:
            write_ply(path, columns(cloud))
    for scan, cloud in zip(read_cloud_folder(tmp_path).read(range(6)), CLOUDS, strict=True):
        np.testing.assert_allclose(scan.points, cloud, atol=6e-4)


def test_clouds_without_a_pose_are_left_out_and_counted(tmp_path):
    stamps = [STAMPS[0] - 10**9, STAMPS[1], STAMPS[2], STAMPS[-1] + 10**9, STAMPS[-1] + 2 * 10**9]
    recording = read_cloud_folder(_timed(tmp_path, stamps))
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS[1:3]
    early, late = recording.remarks
    assert early.startswith("1 of 5 files are left out: they were taken before the first pose")
    assert late.startswith("2 of 5 files are left out: they were taken after the last pose")


def test_counted_clouds_go_with_poses_in_order(tmp_path):
    poses = drive(12)
    write_log(_counted(tmp_path, 12) / "trajectory.log", poses)
    recording = read_cloud_folder(tmp_path)
    for number, scan in enumerate(recording.read(range(12))):
        np.testing.assert_array_equal(scan.points, CLOUDS[number % COUNT])
        np.testing.assert_allclose(scan.world_from_sensor, poses[number].matrix(), atol=1e-7)


def test_poses_without_times_go_to_files_in_the_order_of_the_times_in_their_names(tmp_path):
    write_log(tmp_path / "trajectory.log", POSES[:4])
    for name in ("0.5.ply", "0.25.ply", "1.0.ply", "0.75.ply"):
        write_ply(tmp_path / name, columns(CLOUDS[0]))
    files = read_cloud_folder(tmp_path).files
    assert [file.path.name for file in files] == ["0.25.ply", "0.5.ply", "0.75.ply", "1.0.ply"]
    np.testing.assert_allclose(files[2].world_from_sensor, POSES[2].matrix(), atol=1e-7)


def test_as_many_poses_of_another_clock_go_in_order_and_it_is_said(tmp_path):
    write_tum(_timed(tmp_path) / "trajectory.txt", [s - START_NS for s in STAMPS], POSES)
    recording = read_cloud_folder(tmp_path)
    assert [entry.stamp_ns for entry in recording.entries] == [s - START_NS for s in STAMPS]
    assert "are of another clock than those of trajectory.txt" in recording.remarks[0]


def test_points_in_the_world_frame_are_noticed_and_taken_as_such(tmp_path):
    poses = drive(COUNT, step_m=5.0, start=(412_000.0, 5_400_000.0, 300.0))
    _world_las(tmp_path, poses)
    with pytest.raises(ToolError, match="seem to be in the world frame: .* --points-in world, or"):
        read_cloud_folder(tmp_path)
    read = read_cloud_folder(tmp_path, points_in="world").read(range(COUNT))
    for scan, cloud, pose in zip(read, CLOUDS, matrices(poses), strict=True):
        # Millimetres of the file, and no more: single precision has 25 cm there.
        np.testing.assert_allclose(scan.points, cloud, atol=1e-3)
        np.testing.assert_array_equal(scan.world_from_sensor, pose)
    (scan,) = read_cloud_folder(tmp_path, points_in="sensor").read([0])
    assert np.linalg.norm(scan.points, axis=1).min() > 5e6


def test_motion_is_taken_out_of_clouds_whose_points_have_times(tmp_path):
    """A sensor at 40 m/s passes a wall of points; each is measured from another place."""
    write_tum(tmp_path / "trajectory.txt", STAMPS, drive(COUNT, step_m=4.0, turn_rad=0.0))
    offsets_ns = np.linspace(0, STEP_NS, 101).astype(np.uint32)
    world = np.stack([np.linspace(10, 20, 101), np.full(101, 3.0), np.ones(101)], axis=1)
    at = np.stack([4.0 + 40.0 * offsets_ns / 1e9, np.zeros(101), np.ones(101)], axis=1)
    write_ply(
        tmp_path / f"{_name(STAMPS[1])}.ply",
        columns((world - at).astype(np.float32), t=offsets_ns),
    )
    (scan,) = read_cloud_folder(tmp_path).read([0])
    pose = scan.world_from_sensor
    np.testing.assert_allclose(scan.points @ pose[:3, :3].T + pose[:3, 3], world, atol=2e-3)
    (raw,) = read_cloud_folder(tmp_path, deskew=False).read([0])
    np.testing.assert_allclose(raw.points, world - at, atol=1e-5)


def test_points_that_are_not_finite_are_left_out(tmp_path):
    cloud = np.array([[1, 2, 3], [np.nan, 0, 0], [0, np.inf, 0]], np.float32)
    write_ply(tmp_path / "0.ply", columns(cloud, t=np.arange(3, dtype=np.uint32)))
    write_tum(tmp_path / "a.tum", STAMPS[:1], POSES[:1])
    (scan,) = read_cloud_folder(tmp_path).read([0])
    np.testing.assert_array_equal(scan.points, cloud[:1])


def test_another_trajectory_can_be_chosen(tmp_path):
    _timed(tmp_path)
    other = write_tum(tmp_path / "groundtruth.txt", STAMPS, drive(COUNT, step_m=9.0))
    (remark,) = read_cloud_folder(tmp_path).remarks
    assert remark.startswith("poses are those of trajectory.txt, not of groundtruth.txt: ")
    recording = read_cloud_folder(tmp_path, trajectory=other)
    assert not recording.remarks
    _, second = recording.read([0, 1])
    assert np.linalg.norm(second.world_from_sensor[:2, 3]) == pytest.approx(9.0, rel=1e-3)


def test_viewpoints_are_poses_where_they_differ_and_no_others_are_there(tmp_path):
    for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
        write_pcd(tmp_path / f"{_name(stamp)}.pcd", columns(cloud))
    with pytest.raises(ToolError, match="holds no trajectory"):
        read_cloud_folder(tmp_path)
    for stamp, pose in zip(STAMPS, POSES, strict=True):
        path = tmp_path / f"{_name(stamp)}.pcd"
        (x, y, z), (qx, qy, qz, qw) = pose.position_m, pose.quaternion_xyzw
        said = f"VIEWPOINT {x} {y} {z} {qw} {qx} {qy} {qz}".encode()
        path.write_bytes(re.sub(rb"VIEWPOINT.*", said, path.read_bytes(), count=1))
    recording = read_cloud_folder(tmp_path)
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    assert recording.remarks[0].startswith("poses are the VIEWPOINT of each PCD")
    for scan, pose in zip(recording.read(range(COUNT)), matrices(POSES), strict=True):
        np.testing.assert_allclose(scan.world_from_sensor, pose, atol=1e-9)
    (tmp_path / f"{_name(STAMPS[2])}.pcd").write_bytes(b"")
    with pytest.raises(ToolError, match="holds no trajectory"):
        read_cloud_folder(tmp_path)


def test_folders_that_follow_each_other_are_joined_and_sensors_at_one_time_are_not(tmp_path):
    _timed(tmp_path, STAMPS[:3], "b")
    for stamp, cloud in zip(STAMPS[3:], CLOUDS[3:], strict=True):
        (tmp_path / "a").mkdir(exist_ok=True)
        write_ply(tmp_path / "a" / f"{_name(stamp)}.ply", columns(cloud))
    recording = read_cloud_folder(tmp_path)
    assert recording.streams[0].name == "b/*.ply, a/*.ply"
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    for scan, cloud in zip(recording.read(range(COUNT)), CLOUDS, strict=True):
        np.testing.assert_array_equal(scan.points, cloud)
    write_ply(tmp_path / "a" / f"{_name(STAMPS[1] + 1)}.ply", columns(CLOUDS[0]))
    with pytest.raises(ToolError, match="not one after the other in time: .*give one of these"):
        read_cloud_folder(tmp_path)
    one = read_cloud_folder(tmp_path / "a", trajectory=Path("../trajectory.txt"))
    assert len(one.entries) == 4


def test_what_is_missing_or_too_much_is_named(tmp_path):
    with pytest.raises(ToolError, match="nowhere: no such folder"):
        read_cloud_folder(tmp_path / "nowhere")
    assert not is_cloud_folder(tmp_path / "nowhere")
    assert not is_cloud_folder(tmp_path)
    with pytest.raises(ToolError, match=r"holds no .ply, .pcd, .las, .laz, .bin, nor does"):
        read_cloud_folder(tmp_path)
    _counted(tmp_path, 3)
    with pytest.raises(ToolError, match=r"holds no trajectory, trajectory.txt, .*--trajectory"):
        read_cloud_folder(tmp_path)
    with pytest.raises(ToolError, match="none.txt: no such file"):
        read_cloud_folder(tmp_path, trajectory=tmp_path / "none.txt")
    write_tum(tmp_path / "poses.txt", STAMPS, POSES)
    with pytest.raises(ToolError, match=r"3 files such as 0.ply, and 6 poses in .*hold no times"):
        read_cloud_folder(tmp_path)
    write_log(tmp_path / "poses.txt", POSES[:2])
    with pytest.raises(ToolError, match=r"3 files .*, and 2 poses"):
        read_cloud_folder(tmp_path)
    write_pcd(tmp_path / "3.pcd", columns(CLOUDS[0]))
    with pytest.raises(ToolError, match=r"holds .pcd and .ply: leave only one"):
        read_cloud_folder(tmp_path)
    _counted(tmp_path / "map", 1)
    words = r"clouds lie in .* \(4\), .*map \(1\), .* leave only those .* or give one of these"
    with pytest.raises(ToolError, match=words):
        read_cloud_folder(tmp_path)


def test_clocks_that_differ_are_told_with_both_times(tmp_path):
    _timed(tmp_path, stamps=[stamp + 3600 * 10**9 for stamp in STAMPS[:4]])
    words = r"no file has a pose: .* from 1700003600.000 to 1700003600.300 s, and .* goes from "
    with pytest.raises(ToolError, match=words):
        read_cloud_folder(tmp_path)


def test_clouds_without_any_point_are_refused(tmp_path):
    write_ply(tmp_path / "0.ply", columns(np.empty((0, 3), np.float32)))
    write_tum(tmp_path / "poses.txt", STAMPS[:1], POSES[:1])
    with pytest.raises(ToolError, match="none of the 1 files holds any points"):
        read_cloud_folder(tmp_path)
