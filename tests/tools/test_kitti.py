from pathlib import Path

import numpy as np
import pytest
from support.kitti_folder import write_folder
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.kitti import KittiFolder, is_kitti_folder, read_kitti_folder
from triquad_tools.recordings.recording import Recording

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"


def _turn(angle: float, translation: tuple[float, float, float]) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:3, 3] = translation
    return pose


def _folder(path: Path, poses: str = IDENTITY, scans: int = 1, under: str = "scans") -> Path:
    (path / under).mkdir(parents=True, exist_ok=True)
    (path / "poses.txt").write_text(poses)
    for i in range(scans):
        np.full((2, 4), i, "<f4").tofile(path / under / f"{i:06d}.bin")
    return path


def test_folder_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scans = [rng.normal(size=(n, 3)).astype(np.float32) for n in (5, 0, 3)]
    poses = np.array([_turn(0.1 * i, (i / 3.0, 1e5 + 0.1, -2.0)) for i in range(3)])
    stamps = [1624254615786958123, 1624254615886958123, 1624254616000000007]
    write_folder(tmp_path / "made", scans, poses, stamps)
    read = read_kitti_folder(tmp_path / "made")
    assert len(read) == 3
    assert read.stamps_ns.tolist() == stamps
    np.testing.assert_allclose(read.poses, poses, rtol=0.0, atol=1e-12)
    for i, points in enumerate(scans):
        np.testing.assert_array_equal(read.read_points(i), points)
        assert read.read_points(i).dtype == np.float32


def test_bytes_of_a_written_scan(tmp_path: Path) -> None:
    write_folder(tmp_path, [np.array([[1.0, 2.0, -0.5]], np.float32)], np.eye(4)[None], [5])
    data = (tmp_path / "scans" / "000000.bin").read_bytes()
    assert data == bytes.fromhex("0000803f 00000040 000000bf 00000000")
    assert (tmp_path / "times.txt").read_text() == "0.000000005\n"


@pytest.mark.parametrize("under", [".", "scans", "velodyne", "velodyne_points/data"])
def test_scans_are_found_in_each_layout(tmp_path: Path, under: str) -> None:
    folder = read_kitti_folder(_folder(tmp_path, f"{IDENTITY}\n{IDENTITY}\n", 2, under))
    assert [path.name for path in folder.scan_paths] == ["000000.bin", "000001.bin"]
    assert np.all(folder.read_points(1) == 1.0)
    assert folder.stamps_ns.tolist() == [0, 100_000_000]


def test_calibration_turns_camera_poses_into_lidar_poses(tmp_path: Path) -> None:
    # Camera: x right, y down, z forward. Lidar: x forward, y left, z up, 0.3 m above the camera.
    # The camera moved 2 m forward and 1 m to the right: 2 m along x, -1 m along y of the lidar.
    folder = _folder(tmp_path, "1 0 0 1 0 1 0 0 0 0 1 2")
    (folder / "calib.txt").write_text("P0: 1 2 3\nTr: 0 -1 0 0  0 0 -1 -0.3  1 0 0 0\n")
    pose = read_kitti_folder(folder).poses[0]
    np.testing.assert_allclose(pose[:3, 3], [2.0, -1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3], np.eye(3), atol=1e-12)


def test_calibration_turns_rotations_too(tmp_path: Path) -> None:
    # A turn of the camera by 90 degrees about its y (down) turns the lidar about -z; the lidar,
    # 0.5 m behind the camera, swings around it.
    folder = _folder(tmp_path, "0 0 1 0 0 1 0 0 -1 0 0 0")
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0  0 0 -1 0  1 0 0 -0.5\n")
    pose = read_kitti_folder(folder).poses[0]
    np.testing.assert_allclose(pose[:3, 0], [0.0, -1.0, 0.0], atol=1e-12)  # now looks right
    np.testing.assert_allclose(pose[:3, 3], [0.5, 0.5, 0.0], atol=1e-12)


def test_poses_of_few_digits_are_made_orthonormal(tmp_path: Path) -> None:
    line = (
        "0.651617 -0.758251 -0.0212415 0 0.755308 0.651164 -0.0741323 0 "
        "0.0700426 0.032262 0.997022 0"
    )
    rotation = read_kitti_folder(_folder(tmp_path, line)).poses[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert rotation[0, 0] == pytest.approx(0.651617, abs=1e-5)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1 0 0", "poses.txt:2: 3 numbers"),
        (IDENTITY + " 7", "poses.txt:2: 13 numbers"),
        (IDENTITY.replace("1", "one", 1), "poses.txt:2: 'one' is not a number"),
        ("nan" + IDENTITY[1:], "poses.txt:2: 'nan' is not finite"),
        ("inf" + IDENTITY[1:], "poses.txt:2: 'inf' is not finite"),
        ("1.01" + IDENTITY[1:], "poses.txt:2: not a rotation: off orthonormal by 0.0201"),
        ("-1" + IDENTITY[1:], "poses.txt:2: not a rotation: .*determinant -1"),
    ],
)
def test_bad_pose_is_refused_with_its_place(tmp_path: Path, line: str, words: str) -> None:
    with pytest.raises(ToolError, match=words):
        read_kitti_folder(_folder(tmp_path, f"{IDENTITY}\n{line}\n", 2))


def test_calibration_without_tr_is_refused(tmp_path: Path) -> None:
    (_folder(tmp_path) / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(ToolError, match="calib.txt: has no line 'Tr:'"):
        read_kitti_folder(tmp_path)


def test_scan_of_a_broken_size_is_refused_before_any_is_read(tmp_path: Path) -> None:
    folder = read_kitti_folder(_folder(tmp_path, f"{IDENTITY}\n" * 3, 3))
    folder.scan_paths[2].write_bytes(b"x" * 33)
    words = r"000002.bin: 33 bytes are not whole points of 16"
    with pytest.raises(ToolError, match=words):
        read_kitti_folder(tmp_path)
    with pytest.raises(ToolError, match=words):
        folder.read_points(2)


def test_a_folder_is_a_recording(tmp_path: Path) -> None:
    poses = f"{IDENTITY}\n1 0 0 5 0 1 0 0 0 0 1 0\n{IDENTITY}\n"
    recording: Recording = read_kitti_folder(_folder(tmp_path, poses, 3))
    assert is_kitti_folder(tmp_path)
    assert not is_kitti_folder(tmp_path / "scans" / "none")
    assert [entry.stamp_ns for entry in recording.entries] == [0, 100_000_000, 200_000_000]
    assert {entry.source for entry in recording.entries} == {"default"}
    assert [stream.name for stream in recording.streams] == ["scans/*.bin", "poses.txt"]
    assert not recording.remarks
    first, second = recording.read([1, 2])
    assert np.all(first.points == 1.0)
    assert first.world_from_sensor[0, 3] == 5.0
    assert np.all(second.points == 2.0)


def test_counts_that_differ_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ToolError, match=r"poses.txt: 1 poses for 3 scans"):
        read_kitti_folder(_folder(tmp_path, scans=3))
    (_folder(tmp_path / "b") / "times.txt").write_text("1.0\n2.0\n")
    with pytest.raises(ToolError, match=r"times.txt: 2 times for 1 scans"):
        read_kitti_folder(tmp_path / "b")


def test_missing_parts_are_named(tmp_path: Path) -> None:
    with pytest.raises(ToolError, match="nowhere: no such folder"):
        read_kitti_folder(tmp_path / "nowhere")
    with pytest.raises(ToolError, match=r"holds no poses.txt"):
        read_kitti_folder(tmp_path)
    with pytest.raises(ToolError, match=r"holds no \*.bin"):
        read_kitti_folder(_folder(tmp_path, scans=0))


@pytest.mark.parametrize("times", ["soon\n", "-1\n", "nan\n", "inf\n", "1e30\n", "2\n1\n"])
def test_bad_times_are_refused(tmp_path: Path, times: str) -> None:
    count = times.count("\n")
    (_folder(tmp_path, f"{IDENTITY}\n" * count, count) / "times.txt").write_text(times)
    with pytest.raises(ToolError, match=r"times.txt:\d: "):
        read_kitti_folder(tmp_path)


def _real(name: str) -> KittiFolder:
    if not (DATA / name).is_dir():
        pytest.skip(f"real scans {name} are not in ../shared/data")
    return read_kitti_folder(DATA / name)


@pytest.mark.parametrize(("name", "scans"), [("seosan01", 21), ("kitti07_mini", 5)])
def test_real_folder_is_read(name: str, scans: int) -> None:
    folder = _real(name)
    assert len(folder) == scans
    points = folder.read_points(scans - 1)
    assert len(points) > 15_000
    assert np.isfinite(points).all()
    assert np.all(np.diff(folder.stamps_ns) > 0)


def test_real_scans_agree_in_the_world_frame() -> None:
    from scipy.spatial import cKDTree

    folder = _real("seosan01")
    first, second = (
        folder.read_points(i) @ folder.poses[i, :3, :3].T + folder.poses[i, :3, 3] for i in (4, 5)
    )
    distances = cKDTree(first).query(second[::20])[0]
    assert np.median(distances) < 0.1
