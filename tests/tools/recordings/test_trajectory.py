from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings.trajectories import drive, matrices, write_tum
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.file_names import in_order, stamps_of_names
from triquad_tools.recordings.folders.trajectory import read_trajectory
from triquad_tools.sensors.sweep import NoTransformError

START_NS = 1_700_000_000_000_000_000
LINE = "1 0 0 0 0 0 0 1"
ROW = "1 0 0 0 0 1 0 0 0 0 1 0"  # of KITTI


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


EUROC = "p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
MORE = "".join(
    f", {name}_{axis} [m s^-1]" for name in ("v_RS_R", "b_w_RS_S", "b_a_RS_S") for axis in "xyz"
)
ROS = ["%time", "field.header.stamp", "field.header.frame_id"]
ROS += [f"field.pose.position.{axis}" for axis in "xyz"]
ROS += [f"field.pose.orientation.{axis}" for axis in "xyzw"]
NUMBERS = " 1" * 9


@pytest.mark.parametrize(
    ("header", "form", "separator"),
    [
        ("", "{t} {p} {xyzw}", " "),
        ("# timestamp tx ty tz qx qy qz qw", "{t} {p} {xyzw}", " "),
        ("\ufeff# t, x, y, z, qw, qx, qy, qz\r\n", "{t} {p} {wxyz}", ","),
        ("time_ns;x;y;z;qx;qy;qz;qw", "{ns} {p} {xyzw}", ";"),
        ("", "{ns} {p} {xyzw}", " "),  # HeLiPR
        ("", "{ns} {p} {xyzw}", ","),
        ("", "{ns} {p} {wxyz}", ","),  # EuRoC without its header
        (f"#timestamp [ns], {EUROC}", "{ns} {p} {wxyz}", ","),
        (f"#timestamp, {EUROC}{MORE}", "{ns} {p} {wxyz}" + NUMBERS, ","),
        ("", "{ns} {p} {wxyz}" + NUMBERS, ","),
        ("#sec,nsec,x,y,z,qx,qy,qz,qw", "{sec} {nsec} {p} {xyzw}", ","),
        ("", "{sec} {nsec} {p} {xyzw}", ","),
        ("counter, sec, nsec, x, y, z, qx, qy, qz, qw", "{n} {sec} {nsec} {p} {xyzw}", ", "),
        ("", "{n} {sec} {nsec} {p} {xyzw}", ","),
        ("num,t,x,y,z,qx,qy,qz,qw", "{n} {t} {p} {xyzw}", ","),
        ("", "{n} {t} {p} {xyzw}", ","),
        ("#timestamp x y z qx qy qz qw id", "{t} {p} {xyzw} {n}", " "),
        ("", "{t} {p} {xyzw} {n}", " "),
        ("", "{ns} {rows}", ","),  # MulRan
        ("", "{t} {rows} 0 0 0 1", " "),
        (",".join(ROS), "{late} {ns} odom {p} {xyzw}", ","),
    ],
)
def test_lines_of_data_sets_are_read(tmp_path, header, form, separator):
    stamps, lines = [START_NS + 100_000_001 * number for number in range(30)], [header]
    poses = drive(30)
    for number, (stamp, pose) in enumerate(zip(stamps, poses, strict=True)):
        x, y, z, w = map(repr, map(float, pose.quaternion_xyzw))
        seconds, rest = str(stamp // 10**9), str(stamp % 10**9)
        words = {"ns": stamp, "sec": seconds, "nsec": rest, "t": f"{seconds}.{rest:0>9}"}
        words |= {"n": number, "late": stamp + 7, "xyzw": f"{x} {y} {z} {w}"}
        words |= {"wxyz": f"{w} {x} {y} {z}", "p": " ".join(map(repr, pose.position_m.tolist()))}
        words["rows"] = " ".join(map(repr, pose.matrix()[:3].ravel().tolist()))
        lines.append(form.format(**words).replace(" ", separator))
    path = tmp_path / "a.txt"
    path.write_text("\n".join(lines), encoding="utf-8")
    read = read_trajectory(path)
    np.testing.assert_allclose(read.poses, matrices(poses), atol=1e-12)
    assert read.stamps_ns.tolist() == stamps
    assert read.frames is not None
    assert not read.remarks


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no poses"),
        ("time x y z qx qy qz qw\n", "holds no poses"),
        ("1 2 3 4 5\n", ":1: 5 numbers are no pose in a form that is known; the nearest is "),
        ("1 0 0 0 0.1 0.2 0.3\n", ":1: the quaternion .* length .* a line is x y z qx qy qz qw"),
        ("1 0 0 1.8 0.1 0.2 0.3\n", "roll, pitch and yaw, write quaternions of them"),
        ("t x y z roll pitch yaw\n1 0 0 0 0 0 0\n", ":1: names no qw, qx, qy, qz: name them t x"),
        ("t x y z qx qy qz qw\n1 0 0 0 0 0 0 1 5\n", ":1: names 8 of 9 columns"),
        ("1 0 0 0 1 0 0 0 5\n1 0 0 0 2 0 0 0 5\n", ":1: 9 numbers are no pose"),
        (f"{LINE}\n2 0 0 0\n", ":2: 4 numbers where a pose has 8"),
        (f"{LINE}\n2 0 0 zero 0 0 0 1\n", ":2: 'zero' is not a number"),
        (f"{LINE}\n2 0 0 0 1 0 0 1\n", ":2: .* has the length 1.414, not 1"),
        ("nan 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n", ":1: no finite pose, nor in any other line"),
        ("-1 0 0 0 0 0 0 1\n", ":1: -1 s is out of range: times are seconds"),
        ("170000000000000000 0 0 0 0 0 0 1\n", ":1: .* is out of range: times are seconds"),
        ("1 0,5 0,0 0 0 0 0 1\n", ":1: 0,5 has a comma for its point: write points"),
        ("1,5 0,0 0,0 0,0 0,0 0,0 0,0 1,0\n", ":1: 1,5 has a comma for its point: write points"),
        ("1 0 0 0 1 0 0 0\n2 0 0 0 0.99 0 0 0.141\n", ":1: .* give --quaternion wxyz or --quat"),
        (
            "# t x y z qx qy qz qw\n1 0 0 0 1 0 0 0\n",
            ":2: .* exactly half a turn.* wxyz if that is",
        ),
        (
            "# t x y z qw qx qy qz\n1 0 0 0 0 0 0 1\n",
            ":2: .* exactly half a turn.* xyzw if that is",
        ),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n", "3 lines are not whole poses of Open3D's .log"),
        ("0 0 1\n1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1\n", ":1: not 3 numbers and four rows of 4"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1\n", ":1: .* where a pose ends with 0 0 0 1"),
        ("0 0 1\n1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n", ":1: not a rotation"),
        (f"{ROW}\n1 0 0\n", ":2: 3 numbers"),
        (f"{ROW}\none{ROW[1:]}\n", ":2: 'one' is not a number"),
        (f"{ROW}\n1.01{ROW[1:]}\n", ":2: not a rotation: off orthonormal by 0.0201"),
        (f"{ROW}\n-1{ROW[1:]}\n", ":2: not a rotation: .*determinant -1"),
    ],
)
def test_what_is_no_trajectory_is_refused_with_its_place(tmp_path, text, words):
    path = tmp_path / "trajectory.txt"
    path.write_text(text)
    with pytest.raises(ToolError, match=words):
        read_trajectory(path)


def test_lines_out_of_order_are_sorted_and_lines_without_a_pose_counted(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("3 3 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 nan 0 0 0 0 0 1\n3 3 0 0 0 0 0 1\n")
    read = read_trajectory(path)
    assert read.stamps_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9, 3 * 10**9]
    assert np.isnan(read.pose_at(19 * 10**8)).all()
    assert read.pose_at(3 * 10**9)[0, 3] == 3
    assert [remark.removeprefix(f"{path}: ")[:34] for remark in read.remarks] == [
        "1 of 4 poses are left out, as they",
        "has 4 poses, some with a time befo",
        "has 4 poses, some with a time that",
    ]
    assert read.remarks[0].endswith("a.tum:3")


@pytest.mark.parametrize("apart_s", [0.0, 0.04])
def test_two_trajectories_in_one_file_are_refused(tmp_path, apart_s):
    path = tmp_path / "a.tum"
    places = [(second + other * apart_s, other) for second in range(9) for other in (0, 1)]
    path.write_text("".join(f"{1000 + t} {t} {0.4 * y} 0 0 0 0 1\n" for t, y in places))
    with pytest.raises(ToolError, match="jump to and fro, .* times.* those of two trajectories"):
        read_trajectory(path)


def test_half_a_turn_at_the_start_may_be_right(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("# t x y z qx qy qz qw\n1 0 0 0 1 0 0 0\n")
    assert read_trajectory(path, "xyzw").poses[0].diagonal().tolist() == [1, -1, -1, 1]


def test_a_quaternion_with_w_first_can_be_told(tmp_path):
    path = tmp_path / "a.tum"
    path.write_text("1 0 0 0 1 0 0 0\n2 0 0 0 0.8 0 0 0.6\n")
    read = read_trajectory(path, "wxyz")
    assert read.poses[:, 2, 2].tolist() == [1, 1]
    assert read.poses[1, 0, 0] == pytest.approx(0.64 - 0.36)
    assert read_trajectory(path, "xyzw").poses[0, 2, 2] == -1


def test_poses_may_have_the_numbers_of_scans(tmp_path):
    path = tmp_path / "poses.txt"
    row = " ".join(map(str, np.eye(4).ravel()))
    path.write_text(f"3 {row}\n7 {row}\n")
    assert read_trajectory(path).numbers == [3, 7]
    path.write_text(f"3 {row[: row.rindex('0.0 0.0 0.0 1.0')]}\n")
    assert read_trajectory(path).numbers == [3]


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
        lost = int((~np.isfinite(read.poses).all(axis=(1, 2))).sum())
        assert lost < len(read.poses)
        assert lost == 0 or " poses are left out" in read.remarks[0]
    assert told.startswith(str(path))
    assert "\n" not in told


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["1700000000.25.ply", "cloud_1700000001.5.ply"], [START_NS + 250_000_000, None]),
        (["scan1700000000250.pcd"], [START_NS + 250_000_000]),
        (["1700000000.pcd"], [START_NS]),
        (["n015__LIDAR_TOP__1700000000250000.pcd.bin"], [START_NS + 250_000_000]),
        (["a_1700000000_250000000.pcd"], [START_NS + 250_000_000]),
        (["1700000000_25000000.pcd", "1700000000_250000000.pcd"], [START_NS + 25_000_000, None]),
        (["frame-12.5.laz"], [12_500_000_000]),
    ],
)
def test_times_are_read_of_names(names, stamps):
    read = stamps_of_names([Path(name) for name in names])
    assert read is not None
    assert read[0] == stamps[0]


def test_dates_with_fractions_are_times_across_minutes_and_months():
    names = ["30-11-2023_23-59-59.75.ply", "2023-12-01T00:00:00.250.ply", "a_20231201_000001.5.ply"]
    quarters = [6805555199, 6805555201, 6805555206]
    for name, at in zip(names, quarters, strict=True):
        assert stamps_of_names([Path(name)]) == [at * 25 * 10**7]
    assert stamps_of_names([Path("12-30-58.000000.ply")]) is None


def test_fractions_without_leading_zeros_are_nanoseconds():
    names = [Path("1700000000.5000.ply"), Path("1700000000.100005000.ply")]
    assert stamps_of_names(names) == [17 * 10**17 + 5000, 17 * 10**17 + 100005000]
    decimals = [Path("1700000000.05.ply"), Path("1700000000.1.ply")]
    assert stamps_of_names(decimals) == [17 * 10**17 + 5 * 10**7, 17 * 10**17 + 10**8]


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


def test_images_of_colmap_are_refused(tmp_path):
    path = tmp_path / "images.txt"
    path.write_text(
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n1 1 0 0 0 1 2 3 1 a\n\n"
    )
    with pytest.raises(ToolError, match="COLMAP have poses camera_from_world"):
        read_trajectory(path)
