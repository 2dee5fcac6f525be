import argparse
from pathlib import Path

import numpy as np
import pytest
from support.recordings.kitti_folder import write_folder
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.arguments import add_recording
from triquad_tools.recordings.cloud import world_points
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.recordings.folders.scan_folder import ScanFolder
from triquad_tools.recordings.recording import ReadingOptions, options_of

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"


def _turn(angle: float, translation: tuple[float, float, float]) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:3, 3] = translation
    return pose


def _points(folder: ScanFolder, index: int) -> np.ndarray:
    (scan,) = folder.read([index])
    return scan.points


def _poses(folder: ScanFolder) -> np.ndarray:
    return np.array([file.world_from_sensor for file in folder.files])


def _stamps(folder: ScanFolder) -> list[int]:
    return [entry.stamp_ns for entry in folder.entries]


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
    read = read_cloud_folder(tmp_path / "made")
    assert len(read) == 3
    assert _stamps(read) == stamps
    np.testing.assert_allclose(_poses(read), poses, rtol=0.0, atol=1e-12)
    for i, points in enumerate(scans):
        np.testing.assert_array_equal(_points(read, i), points)
        assert _points(read, i).dtype == np.float32


@pytest.mark.parametrize("under", [".", "scans", "velodyne", "velodyne_points/data"])
def test_scans_are_found_in_each_layout(tmp_path: Path, under: str) -> None:
    folder = read_cloud_folder(_folder(tmp_path, f"{IDENTITY}\n{IDENTITY}\n", 2, under))
    assert [file.path.name for file in folder.files] == ["000000.bin", "000001.bin"]
    assert np.all(_points(folder, 1) == 1.0)
    assert _stamps(folder) == [0, 100_000_000]


def test_poses_and_calibration_may_lie_elsewhere(tmp_path: Path) -> None:
    """As data sets of KITTI and KITTI-360 have them: no pose for the first scan of the latter."""
    forward = [f"1 0 0 0 0 1 0 0 0 0 1 {z}" for z in (0, 4, 8)]  # of a camera, along its z
    folder = _folder(tmp_path / "00", scans=3, under="velodyne")
    (folder / "poses.txt").unlink()
    (folder / "velodyne" / "._000000.bin").write_bytes(b"of macOS")
    (tmp_path / "00.txt").write_text("\n".join(forward))
    of_camera = ReadingOptions(trajectory=tmp_path / "00.txt")
    with pytest.raises(ToolError, match=r"drives along its z, .* no calib.txt with a line 'Tr:'"):
        read_cloud_folder(folder / "velodyne", of_camera)
    tr = "0 -1 0 0 0 0 -1 0 1 0 0 0.5"
    (folder / "calib.txt").write_text(f"P0: {IDENTITY}\nTr: {tr}\n")
    for path in (folder, folder / "velodyne"):
        poses = _poses(read_cloud_folder(path, of_camera))
        np.testing.assert_allclose(poses[:, :3, :3], 3 * [np.eye(3)], atol=1e-12)
        np.testing.assert_allclose(poses[:, 0, 3], [0, 4, 8], atol=1e-12)
    (folder / "calib.txt").unlink()
    (folder / "calib_cam_to_velo.txt").write_text("0 0 1 -0.5 -1 0 0 0 0 -1 0 0")
    rows = [f"{i} 0 0 1 {4 * i} -1 0 0 0 0 -1 0 0 0 0 0 1" for i in (1, 2)]
    (tmp_path / "00.txt").write_text("\n".join(rows))
    folder_360 = read_cloud_folder(folder, of_camera)
    assert _stamps(folder_360) == [100_000_000, 200_000_000]
    assert folder_360.remarks[0].startswith("1 of 3 files are left out, as 00.txt")
    np.testing.assert_allclose(_poses(folder_360)[:, :3, :3], 2 * [np.eye(3)], atol=1e-12)
    np.testing.assert_allclose(_poses(folder_360)[:, 0, 3], [4.5, 8.5], atol=1e-12)
    (tmp_path / "00.txt").write_text("\n".join([*rows, "3" + rows[1][1:]]))
    with pytest.raises(ToolError, match="3 poses in .* their numbers are not those of the poses"):
        read_cloud_folder(folder, of_camera)


def test_calibration_turns_rotations_too(tmp_path: Path) -> None:
    # A turn of the camera by 90 degrees about its y (down) turns the lidar about -z; the lidar,
    # 0.5 m behind the camera, swings around it.
    folder = _folder(tmp_path, "0 0 1 0 0 1 0 0 -1 0 0 0")
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0  0 0 -1 0  1 0 0 -0.5\n")
    pose = _poses(read_cloud_folder(folder))[0]
    np.testing.assert_allclose(pose[:3, 0], [0.0, -1.0, 0.0], atol=1e-12)  # now looks right
    np.testing.assert_allclose(pose[:3, 3], [0.5, 0.5, 0.0], atol=1e-12)


@pytest.mark.parametrize("names", ["xyz", "xyzi", "xyzir", "xyzirt", "t,x,y,z,i"])
@pytest.mark.parametrize("shuffled", [False, True])
def test_columns_are_told_or_given(tmp_path: Path, names: str, *, shuffled: bool) -> None:
    """A room that a spinning lidar sees, 16 points column by column."""
    folder, rng = _folder(tmp_path, f"{IDENTITY}\n{IDENTITY}\n", 2), np.random.default_rng(0)
    turn = np.repeat(np.linspace(0, 2 * np.pi, 300), 16)
    up = np.tile(np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]), 300)
    rays = np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], axis=1)
    points = rays * np.min([20, 5, 3] / np.maximum(np.abs(rays), 1e-9), axis=1)[:, None]
    values = {"i": rng.uniform(0, 1, 4800), "r": np.arange(4800) % 16, "t": turn / 60}
    values |= dict(zip("xyz", points.T, strict=True))
    table = np.stack([values[name] for name in names.replace(",", "")], axis=1).astype("<f4")
    for file in (tmp_path / "scans").iterdir():
        (rng.permutation(table) if shuffled else table).tofile(file)
    if names != "xyzi":
        looks_like = "6" if names == "xyzirt" else str(table.shape[1])
        with pytest.raises(ToolError, match=f"but rather of {looks_like}: .* --columns xyz"):
            read_cloud_folder(folder)
    parser = argparse.ArgumentParser()
    add_recording(parser)
    options = options_of(parser.parse_args([str(folder), "--columns", names]))
    read = _points(read_cloud_folder(folder, options), 1)
    order = np.lexsort(read.T), np.lexsort(points.astype(np.float32).T)
    np.testing.assert_array_equal(read[order[0]], points.astype(np.float32)[order[1]])


def test_doubles_are_no_points(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rng.normal(0, 20, (2000, 4)).tofile(_folder(tmp_path) / "scans" / "000000.bin")
    with pytest.raises(ToolError, match="000000.bin: its numbers are no metres, read as float32"):
        read_cloud_folder(tmp_path)


def test_calibration_without_tr_is_refused(tmp_path: Path) -> None:
    (_folder(tmp_path) / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(ToolError, match="calib.txt: has no line 'Tr:'"):
        read_cloud_folder(tmp_path)


def test_scan_of_a_broken_size_is_refused_before_any_is_read(tmp_path: Path) -> None:
    folder = read_cloud_folder(_folder(tmp_path, f"{IDENTITY}\n" * 3, 3))
    folder.files[2].path.write_bytes(b"x" * 33)
    words = r"000002.bin: cannot be read: 33 bytes are not whole points of 16"
    with pytest.raises(ToolError, match=words):
        read_cloud_folder(tmp_path)
    with pytest.raises(ToolError, match=words):
        _points(folder, 2)


def test_more_times_than_scans_are_refused(tmp_path: Path) -> None:
    (_folder(tmp_path) / "times.txt").write_text("1.0\n2.0\n")
    with pytest.raises(ToolError, match=r"times.txt: 2 times for 1 scans"):
        read_cloud_folder(tmp_path)


@pytest.mark.parametrize("times", ["soon\n", "-1\n", "1e30\n", "2\n1\n"])
def test_bad_times_are_refused(tmp_path: Path, times: str) -> None:
    count = times.count("\n")
    (_folder(tmp_path, f"{IDENTITY}\n" * count, count) / "times.txt").write_text(times)
    with pytest.raises(ToolError, match=r"times.txt:\d: "):
        read_cloud_folder(tmp_path)


def _real(name: str) -> ScanFolder:
    if not (DATA / name).is_dir():
        pytest.skip(f"real scans {name} are not in ../shared/data")
    return read_cloud_folder(DATA / name)


@pytest.mark.parametrize(("name", "scans"), [("seosan01", 21), ("kitti07_mini", 5)])
def test_real_folder_is_read(name: str, scans: int) -> None:
    folder = _real(name)
    assert len(folder) == scans
    points = _points(folder, scans - 1)
    assert len(points) > 15_000
    assert np.isfinite(points).all()
    assert np.all(np.diff(_stamps(folder)) > 0)


def test_real_scans_agree_in_the_world_frame() -> None:
    from scipy.spatial import cKDTree

    folder = _real("seosan01")
    first, second = map(world_points, folder.read([4, 5]))
    distances = cKDTree(first).query(second[::20])[0]
    assert np.median(distances) < 0.1


def test_poses_of_the_official_layout_are_found(tmp_path: Path) -> None:
    folder = tmp_path / "sequences" / "07"
    folder.mkdir(parents=True)
    np.ones((5, 4), np.float32).tofile(folder / "000000.bin")
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "07.txt").write_text("1 0 0 7 0 1 0 8 0 0 1 9\n")
    (scan,) = read_cloud_folder(folder).read([0])
    assert scan.world_from_sensor[:3, 3].tolist() == [7, 8, 9]
