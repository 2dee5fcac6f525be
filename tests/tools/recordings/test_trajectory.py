from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings.trajectories import drive, matrices, write_log, write_tum
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.scan_folder import in_order, stamps_of_names
from triquad_tools.recordings.folders.trajectory import read_trajectory
from triquad_tools.sensors.sweep import NoTransformError

START_NS = 1_700_000_000_000_000_000
LINE = "1 0 0 0 0 0 0 1"


def test_tum_comes_back_and_is_interpolated(tmp_path):
    stamps = [START_NS + 100_000_001 * number for number in range(5)]
    poses = drive(5)
    read = read_trajectory(write_tum(tmp_path / "a.txt", stamps, poses))
    assert read.stamps_ns.tolist() == stamps
    np.testing.assert_allclose(read.poses, matrices(poses), atol=1e-12)
    for stamp, pose in zip(stamps, matrices(poses), strict=True):
        np.testing.assert_allclose(read.pose_at(stamp), pose, atol=1e-12)
    between = read.pose_at((stamps[1] + stamps[2]) // 2)
    np.testing.assert_allclose(between[:3, 3], (read.poses[1] + read.poses[2])[:3, 3] / 2)
    assert np.arctan2(between[1, 0], between[0, 0]) == pytest.approx(0.075)


def test_a_time_that_was_rounded_finds_the_pose_at_the_end(tmp_path):
    read = read_trajectory(write_tum(tmp_path / "a.txt", [START_NS, START_NS + 10**9], drive(2)))
    np.testing.assert_array_equal(read.pose_at(START_NS - 500_000), read.poses[0])
    with pytest.raises(NoTransformError, match="before the first pose"):
        read.pose_at(START_NS - 2_000_000)


def test_open3d_and_kitti_come_without_times(tmp_path):
    poses = drive(4)
    log = read_trajectory(write_log(tmp_path / "trajectory.log", poses))
    np.testing.assert_allclose(log.poses, matrices(poses), atol=1e-7)
    assert log.frames is None
    rows = matrices(poses)[:, :3].reshape(4, 12)
    np.savetxt(tmp_path / "poses.txt", rows)
    np.testing.assert_allclose(read_trajectory(tmp_path / "poses.txt").poses, matrices(poses))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no poses"),
        ("1 2 3 4 5\n", ":1: 5 numbers, where a pose has 8 .t x y z qx qy qz qw."),
        ("time x y z qx qy qz qw\n", ":1: 'time' is not a number of seconds"),
        (f"{LINE}\n2 0 0 0\n", ":2: 4 numbers where a pose has 8"),
        (f"{LINE}\n2 0 0 zero 0 0 0 1\n", ":2: 'zero' is not a number"),
        (f"{LINE}\n2 0 0 nan 0 0 0 1\n", ":2: 'nan' is not finite"),
        (f"{LINE}\n2 0 0 0 1 0 0 1\n", ":2: .* has the length 1.414, not 1"),
        (f"{LINE}\n0.5 0 0 0 0 0 0 1\n", ":2: 0.5 s is before the line above: sort"),
        ("1700000000000000000 0 0 0 0 0 0 1\n", ":1: .* out of range: times are seconds"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n", "3 lines are not whole poses of Open3D's .log"),
        ("0 0 1\n1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1\n", ":1: not 3 numbers and four rows of 4"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n", ":5: '0 0 1 1' where a pose ends"),
        ("0 0 1\n1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n", ":1: not a rotation"),
    ],
)
def test_what_is_no_trajectory_is_refused_with_its_place(tmp_path, text, words):
    path = tmp_path / "trajectory.txt"
    path.write_text(text)
    with pytest.raises(ToolError, match=words):
        read_trajectory(path)


words = st.sampled_from(["0", "1", "-1", "2.5", "nan", "1e400", "x", "#"]) | st.text(max_size=4)
texts = st.lists(st.lists(words, max_size=13).map(" ".join), max_size=8).map("\n".join)


@given(texts | st.text())
def test_whatever_a_file_says_it_is_poses_or_one_line(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("any") / "trajectory.txt"
    path.write_text(text, errors="replace")
    try:
        read = read_trajectory(path)
    except ToolError as error:
        told = str(error)
    else:
        told = f"{path}"
        assert np.isfinite(read.poses).all()
    assert told.startswith(str(path))
    assert "\n" not in told


def test_commas_and_comments_are_allowed(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("# t, x\n1.5,1,2,3,0,0,0,1\n\n  # more\n2.5, 2,2,3, 0,0,0,1\n")
    assert read_trajectory(path).poses[:, 0, 3].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["1700000000.25.ply", "cloud_1700000001.5.ply"], [START_NS + 250_000_000, None]),
        (["scan1700000000250.pcd"], [START_NS + 250_000_000]),
        (["1700000000.pcd"], [START_NS]),
        (["a_1700000000_250000000.pcd"], [START_NS + 250_000_000]),
        (["1700000000_25000000.pcd", "1700000000_250000000.pcd"], [START_NS + 25_000_000, None]),
        (["frame-12.5.laz"], [12_500_000_000]),
    ],
)
def test_times_are_read_of_names(names, stamps):
    read = stamps_of_names([Path(name) for name in names])
    assert read is not None
    assert read[0] == stamps[0]


@pytest.mark.parametrize(
    "name",
    ["000012.ply", "12.ply", "0000000012.ply", "cloud.ply", "20240131_120000.ply", "1.2.3.ply"]
    + ["00001-000000033369.png"],
)
def test_counts_and_dates_are_no_times(name):
    assert stamps_of_names([Path(name)]) is None
    assert stamps_of_names([Path("1700000000.5.ply"), Path(name)]) is None


@given(st.lists(st.integers(0, 10**6), unique=True))
def test_files_are_ordered_by_their_numbers(numbers):
    paths = [Path(f"scan{number}.ply") for number in numbers]
    assert in_order(paths) == [Path(f"scan{number}.ply") for number in sorted(numbers)]
