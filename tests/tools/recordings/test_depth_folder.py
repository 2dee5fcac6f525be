"""Folders of depth images, of a room that a camera sees exactly."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from support.files.file_damage import flipped
from support.recordings.trajectories import drive, matrices, write_log, write_tum
from triquad_client.depth_image import Intrinsics
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders import depth_folder
from triquad_tools.recordings.folders.depth_folder import is_depth_folder
from triquad_tools.recordings.folders.scan_folder import ScanFolder
from triquad_tools.recordings.recording import ReadingOptions

START_NS = 1_305_031_102_160_407_000
STEP_NS = 33_000_000
COUNT = 5
STAMPS = [START_NS + STEP_NS * number for number in range(COUNT)]
POSES = drive(COUNT, step_m=0.1, turn_rad=0.2, start=(0.3, -0.2, 0.1))


CAMERA = Intrinsics(60.0, 62.0, 31.5, 23.5)
WIDTH, HEIGHT = 64, 48
HALF_ROOM_M = 2.0


def room_depth(world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depths [HEIGHT, WIDTH] of the walls of a cube around the origin, metres."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack(
        [(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(rows.shape)],
        axis=-1,
    )
    directions = rays @ world_from_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        reach = (np.sign(directions) * HALF_ROOM_M - world_from_camera[:3, 3]) / directions
    depth: NDArray[np.float64] = reach.min(axis=-1)
    return depth


def write_depth(path: Path, depth: NDArray[np.float64], units_per_metre: float) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(depth * units_per_metre).astype(np.uint16)).save(path)
    return path


def write_intrinsics(path: Path, camera: Intrinsics = CAMERA, width: int = WIDTH) -> Path:
    matrix = [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1]
    said = {"width": width, "height": HEIGHT, "intrinsic_matrix": matrix}
    path.write_text(json.dumps(said))
    return path


def write_list(folder: Path, stamps_ns: Sequence[int]) -> list[Path]:
    """``depth.txt`` of TUM RGB-D; returns the paths of the images that it names."""
    names = [f"depth/{stamp // 10**9}.{stamp % 10**9 // 1000:06d}.png" for stamp in stamps_ns]
    lines = ["# depth maps", "# timestamp filename"]
    lines += [f"{name[6:-4]} {name}" for name in names]
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    return [folder / name for name in names]


def read_depth_folder(folder: Path, **options) -> ScanFolder:
    return depth_folder.read_depth_folder(folder, ReadingOptions(**options))


def _tum(folder: Path, units: float = 5000.0) -> Path:
    folder.mkdir(exist_ok=True)
    write_tum(folder / "groundtruth.txt", STAMPS, POSES)
    write_intrinsics(folder / "camera_intrinsic.json")
    paths = write_list(folder, STAMPS)
    for path, pose in zip(paths, matrices(POSES), strict=True):
        write_depth(path, room_depth(pose), units)
    return folder


def _open3d(folder: Path, units: float = 1000.0) -> Path:
    write_log(folder / "trajectory.log", POSES)
    write_intrinsics(folder / "camera_intrinsic.json")
    for number, pose in enumerate(matrices(POSES)):
        name = f"{number + 1:05d}-{number * 33369:012d}.png"  # as Redwood names them
        write_depth(folder / "depth" / name, room_depth(pose), units)
    return folder


def _off_the_walls_m(recording: ScanFolder) -> float:
    """How far any point lies from the walls of the room, at most."""
    worst = 0.0
    for scan in recording.read(range(len(recording.entries))):
        pose = scan.world_from_sensor
        points = scan.points @ pose[:3, :3].T + pose[:3, 3]
        worst = max(worst, float(np.abs(np.abs(points).max(axis=1) - HALF_ROOM_M).max()))
    return worst


def test_images_of_tum_show_the_room(tmp_path):
    recording = read_depth_folder(_tum(tmp_path))
    assert is_depth_folder(tmp_path)
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS
    assert {entry.source for entry in recording.entries} == {"default"}
    assert [(s.name, s.count) for s in recording.streams] == [
        ("depth/*.png", COUNT),
        ("groundtruth.txt", COUNT),
    ]
    assert not recording.remarks
    assert _off_the_walls_m(recording) < 5e-4
    (scan,) = recording.read([0])
    assert scan.points.shape == (48 * 64, 3)


def test_images_of_open3d_show_the_room(tmp_path):
    recording = read_depth_folder(_open3d(tmp_path))
    assert is_depth_folder(tmp_path)
    assert len(recording.entries) == COUNT
    assert np.diff([entry.stamp_ns for entry in recording.entries]).min() > 0
    assert _off_the_walls_m(recording) < 2e-3


def test_images_of_open3d_go_with_a_trajectory_of_tum_by_their_times(tmp_path):
    write_tum(tmp_path / "trajectory.txt", STAMPS, POSES)
    for stamp, pose in zip(STAMPS[1:], matrices(POSES)[1:], strict=True):
        write_depth(tmp_path / "depth" / f"{stamp}.png", room_depth(pose), 1000.0)
    recording = read_depth_folder(tmp_path, intrinsics=CAMERA)
    assert [entry.stamp_ns for entry in recording.entries] == STAMPS[1:]
    assert _off_the_walls_m(recording) < 2e-3


def _write_images(folder: Path, name: str, units: float) -> None:
    for number, pose in enumerate(matrices(POSES)):
        write_depth(folder / name.format(number), room_depth(pose), units)


def _write_poses(folder: Path, name: str, lost: int | None = None) -> None:
    folder.mkdir(exist_ok=True)
    for number, pose in enumerate(matrices(POSES)):
        pose = np.full((4, 4), -np.inf) if number == lost else pose
        np.savetxt(folder / name.format(number), pose, fmt="%.9f")


def test_images_of_replica_show_the_room(tmp_path):
    folder = tmp_path / "office0"
    _write_images(folder, "results/depth{:06d}.png", 6553.5)
    (folder / "results" / "frame000000.jpg").write_bytes(b"colour")
    np.savetxt(folder / "traj.txt", matrices(POSES).reshape(-1, 16), fmt="%.9f")
    with pytest.raises(ToolError, match="camera is not known"):
        read_depth_folder(folder)
    said = {"w": 64, "h": 48, "fx": 60, "fy": 62, "cx": 31.5, "cy": 23.5, "scale": 6553.5}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": said}))
    recording = read_depth_folder(folder)
    assert is_depth_folder(folder)
    assert _off_the_walls_m(recording) < 5e-4
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": {**said, "scale": 3276.75}}))
    assert _off_the_walls_m(read_depth_folder(folder)) > 0.5


def test_images_of_scannet_show_the_room_where_it_knows_a_pose(tmp_path):
    _write_images(tmp_path, "depth/{}.png", 1000.0)
    _write_poses(tmp_path / "pose", "{}.txt", lost=2)
    (tmp_path / "intrinsic").mkdir()
    matrix = np.diag([60.0, 62, 1, 1])
    matrix[:2, 2] = 31.5, 23.5
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_depth.txt", matrix)
    recording = read_depth_folder(tmp_path)
    assert [file.path.name for file in recording.files] == ["0.png", "1.png", "3.png", "4.png"]
    assert _off_the_walls_m(recording) < 2e-3
    assert "1 of 5 poses are left out" in recording.remarks[0]
    assert recording.remarks[0].endswith("pose/2.txt")


def test_images_of_7_scenes_show_the_room_where_they_are_measured(tmp_path):
    folder = tmp_path / "seq-01"
    _write_poses(folder, "frame-{:06d}.pose.txt")
    _write_images(folder, "frame-{:06d}.depth.png", 1000.0)
    (folder / "frame-000000.color.png").write_bytes(b"colour")
    (folder / "frame-000003.pose.txt").unlink()
    with pytest.raises(ToolError, match=r"64 x 48 pixels, and the camera of the page of 7-Scenes"):
        read_depth_folder(folder)
    depth = room_depth(matrices(POSES)[0])
    depth[10:20] = 65.535
    write_depth(folder / "frame-000000.depth.png", depth, 1000.0)
    recording = read_depth_folder(folder, intrinsics=CAMERA)
    assert _off_the_walls_m(recording) < 2e-3
    assert len(next(iter(recording.read([0]))).points) == 38 * 64
    assert recording.remarks[0].startswith("1 of 5 files are left out, as *")


def test_units_and_stride_can_be_given(tmp_path):
    folder = _open3d(tmp_path, units=6553.5)
    recording = read_depth_folder(folder, units_per_metre=6553.5, stride=4)
    assert _off_the_walls_m(recording) < 5e-4
    (scan,) = recording.read([2])
    assert scan.points.shape == (12 * 16, 3)


def test_the_camera_of_tum_is_known_by_the_name_of_its_folder(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg1_desk"
    _tum(folder)
    (folder / "camera_intrinsic.json").unlink()
    with pytest.raises(ToolError, match=r"64 x 48 pixels, and the camera of .* 640 x 480"):
        read_depth_folder(folder)
    for path in (folder / "depth").iterdir():
        write_depth(path, np.full((480, 640), 2.0), 5000.0)
    (scan,) = read_depth_folder(folder).read([0])
    np.testing.assert_allclose(scan.points[0], [-319.5 * 2 / 525, -239.5 * 2 / 525, 2], rtol=1e-6)


def test_an_image_that_shows_nothing_is_a_scan_without_points(tmp_path):
    _open3d(tmp_path)
    write_depth(next((tmp_path / "depth").iterdir()), np.zeros((48, 64)), 1000.0)
    counts = [len(scan.points) for scan in read_depth_folder(tmp_path).read(range(COUNT))]
    assert sorted(counts) == [0, 3072, 3072, 3072, 3072]


def test_a_damaged_image_is_told_before_the_first_scan(tmp_path):
    path = sorted((_open3d(tmp_path) / "depth").iterdir())[3]
    whole = path.read_bytes()
    middle = len(whole) // 2
    for content in (whole[:middle], whole[:20], b"", flipped(whole, middle)):
        path.write_bytes(content)
        with pytest.raises(ToolError, match=f"{re.escape(path.name)}: cannot be read as PNG"):
            read_depth_folder(tmp_path)


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_images_of_colour_or_8_bits_are_refused(tmp_path, mode):
    path = next((_open3d(tmp_path) / "depth").iterdir())
    Image.new(mode, (64, 48)).save(path)
    with pytest.raises(ToolError, match=f"{path.name}: is an image of mode {mode}: depth takes 16"):
        read_depth_folder(tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "has no width, height and intrinsic_matrix"),
        ('{"width": 64, "height": 48}', "'intrinsic_matrix'"),
        (
            '{"width": 64, "height": 48, "intrinsic_matrix": [60, 0, 31, 0, 60, 23, 0, 0, 1]}',
            "column by column",
        ),
        (
            '{"width": 640, "height": 480, "intrinsic_matrix": [60, 0, 0, 0, 60, 0, 31, 23, 1]}',
            "64 x 48 pixels, and the camera of camera_intrinsic.json 640 x 480",
        ),
    ],
)
def test_intrinsics_that_are_not_understood_or_do_not_fit_are_refused(tmp_path, text, words):
    (_open3d(tmp_path) / "camera_intrinsic.json").write_text(text)
    with pytest.raises(ToolError, match=words):
        read_depth_folder(tmp_path)


def test_given_intrinsics_of_larger_images_are_refused(tmp_path):
    camera = Intrinsics(525, 525, 319.5, 239.5)
    with pytest.raises(ToolError, match=r"64 x 48 pixels, and the centre .* at 319.5, 239.5"):
        read_depth_folder(_open3d(tmp_path), intrinsics=camera)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# nothing\n", "depth.txt: lists no images"),
        ("1.0\n", "depth.txt:1: '1.0' where a line is the time"),
        ("soon depth/a.png\n", "depth.txt:1: 'soon' is not a number of seconds"),
        ("1.0 depth/none.png\n", "depth.txt:1: .*none.png: no such file"),
        ("2.0 depth.txt\n1.0 depth.txt\n", "depth.txt:2: 1.0 is before the line above"),
    ],
)
def test_a_list_that_is_not_understood_is_refused(tmp_path, text, words):
    (_tum(tmp_path) / "depth.txt").write_text(text)
    with pytest.raises(ToolError, match=words):
        read_depth_folder(tmp_path)


def test_what_is_missing_is_named(tmp_path):
    assert not is_depth_folder(tmp_path)
    _open3d(tmp_path)
    (tmp_path / "trajectory.log").unlink()
    with pytest.raises(ToolError, match="holds no trajectory"):
        read_depth_folder(tmp_path)
    (tmp_path / "camera_intrinsic.json").unlink()
    with pytest.raises(ToolError, match=r"camera is not known: .*--intrinsics FX,FY,CX,CY"):
        read_depth_folder(tmp_path)
    write_log(tmp_path / "trajectory.log", POSES[:3])
    with pytest.raises(ToolError, match="5 files such as .*, and 3 poses"):
        read_depth_folder(tmp_path, intrinsics=CAMERA)
