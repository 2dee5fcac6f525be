import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.point_files import (
    PCD_FORMATS,
    PLY_FORMATS,
    columns,
    write_las,
    write_pcd,
    write_ply,
)
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_files.las import check_las, read_las
from triquad_tools.recordings.folders.point_files.pcd import check_pcd, read_pcd
from triquad_tools.recordings.folders.point_files.ply import check_ply, read_ply

CHECKS = {".ply": check_ply, ".pcd": check_pcd, ".las": check_las, ".laz": check_las}
READERS = {".ply": read_ply, ".pcd": read_pcd, ".las": read_las, ".laz": read_las}

CLOUD = np.round(np.random.default_rng(0).normal(0, 9, (400, 3)))  # so that it can be compressed

singles = arrays(
    np.float32,
    st.tuples(st.integers(0, 20), st.just(3)),
    elements=st.floats(-1e6, 1e6, width=32) | st.just(np.nan) | st.just(np.inf),
)
millimetres = arrays(
    np.int64, st.tuples(st.integers(0, 20), st.just(3)), elements=st.integers(-(10**8), 10**8)
)


def _file(path: Path, form: str) -> Path:
    points = columns(CLOUD.astype(np.float32))
    if path.suffix == ".ply":
        return write_ply(path, points, form)
    if path.suffix == ".pcd":
        return write_pcd(path, points, form)
    return write_las(path, CLOUD, int(form))


def _told_of(path: Path) -> str:
    """What is told of a file, nothing where points are read of it."""
    try:
        return "" if READERS[path.suffix](path).points.shape[1:] == (3,) else "no points"
    except ToolError as error:
        return str(error)


FILES = [
    *(("a.ply", form) for form in PLY_FORMATS),
    *(("a.pcd", form) for form in PCD_FORMATS),
    *((name, form) for name in ("a.las", "a.laz") for form in ("3", "7")),
]


@given(singles, st.sampled_from(PLY_FORMATS), st.sampled_from(["f4", "f8"]))
def test_points_of_ply_come_back(tmp_path_factory, points, form, dtype):
    path = tmp_path_factory.mktemp("ply") / "cloud.ply"
    write_ply(path, columns(points.astype(dtype)), form)
    assert check_ply(path) == len(points)
    np.testing.assert_array_equal(read_ply(path).points, points)


@given(singles, st.sampled_from(PCD_FORMATS), st.sampled_from([np.float32, np.float64]))
def test_points_of_pcd_come_back(tmp_path_factory, points, form, dtype):
    path = tmp_path_factory.mktemp("pcd") / "cloud.pcd"
    if form == "ascii" and len(points) == 0:
        return  # the library that writes here cannot
    write_pcd(path, columns(points.astype(dtype)), form)
    assert check_pcd(path) == len(points)
    precision = 1e-6 if form == "ascii" else 0.0  # of what writes here
    np.testing.assert_allclose(read_pcd(path).points, points, rtol=precision, atol=precision)


@given(millimetres, st.sampled_from([".las", ".laz"]), st.sampled_from([1, 3, 7]))
def test_points_of_las_come_back(tmp_path_factory, points, suffix, point_format):
    path = tmp_path_factory.mktemp("las") / f"cloud{suffix}"
    metres = points / 1000.0 + (500_000.0, 5_400_000.0, 300.0)  # as surveyors have them
    write_las(path, metres, point_format)
    assert check_las(path) == len(points)
    np.testing.assert_allclose(read_las(path).points, metres, rtol=0.0, atol=1e-6)


def test_ply_reads_as_trimesh_does(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    box.export(tmp_path / "box.ply")
    np.testing.assert_allclose(read_ply(tmp_path / "box.ply").points, box.vertices)
    trimesh.PointCloud(CLOUD).export(tmp_path / "cloud.ply")
    np.testing.assert_allclose(read_ply(tmp_path / "cloud.ply").points, CLOUD, rtol=1e-6)


@pytest.mark.parametrize("form", PLY_FORMATS)
def test_times_of_points_are_found_among_other_fields(tmp_path, form):
    times = np.arange(400, dtype=np.uint32) * 250_000
    rings = np.arange(400, dtype=np.uint8)
    values = {"ring": rings, **columns(CLOUD.astype(np.float32), t=times)}
    read = read_ply(write_ply(tmp_path / "a.ply", values, form))
    np.testing.assert_array_equal(read.times, times)
    read = read_pcd(write_pcd(tmp_path / "a.pcd", values, form.partition("_")[0]))
    np.testing.assert_array_equal(read.times, times)
    np.testing.assert_allclose(read.points, CLOUD, rtol=1e-5)


def test_ascii_pcd_with_more_blanks_than_one_is_read(tmp_path):
    path = write_pcd(tmp_path / "a.pcd", columns(np.eye(3, dtype=np.float32)), "ascii")
    header, _, _ = path.read_text().partition("DATA ascii\n")
    path.write_text(header + "DATA ascii\n1 0  0 \n\n0 1 0\n 0 0 nan\n")
    np.testing.assert_array_equal(read_pcd(path).points, [[1, 0, 0], [0, 1, 0], [0, 0, np.nan]])


@pytest.mark.parametrize(("name", "form"), FILES)
def test_a_file_cut_anywhere_is_told_without_its_points(tmp_path, name, form):
    path = _file(tmp_path / name, form)
    whole = path.read_bytes()
    assert CHECKS[path.suffix](path) == 400
    for cut in [0, 3, 20, 90, 227, 300, 1000, len(whole) // 2, len(whole) - 60]:
        path.write_bytes(whole[:cut])
        with pytest.raises(ToolError, match=f"^{re.escape(str(path))}: "):
            CHECKS[path.suffix](path)


@pytest.mark.parametrize(("name", "form"), FILES)
def test_whatever_a_file_holds_reading_ends_in_points_or_one_error(tmp_path, name, form):
    path = _file(tmp_path / name, form)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(150):
        damaged = bytearray(whole)
        for place in rng.integers(0, 2 * 400 if rng.random() < 0.7 else len(whole), 3):
            damaged[place % len(whole)] = rng.integers(256)
        path.write_bytes(damaged)
        told = _told_of(path)
        assert told == "" or told.startswith(f"{path}: ")
        assert "\n" not in told


@pytest.mark.parametrize("write", [write_ply, write_pcd])
def test_a_file_without_z_is_refused(tmp_path, write):
    path = tmp_path / f"flat.{write.__name__[-3:]}"
    column = np.zeros(4, np.float32)
    write(path, {"x": column, "y": column, "height": column})
    with pytest.raises(ToolError, match=r"flat.p..: has no z for its points, only x, y, height"):
        CHECKS[path.suffix](path)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("plyx", "does not begin with 'ply'"),
        ("ply\nelement vertex 1\nproperty float x\nend_header\n", "names no format"),
        ("ply\nformat ascii 1.0\nend_header\n", "names no format or no vertices"),
        ("ply\nformat ascii 1.0\nelement face 3\n", "'element face 3' .* vertices come first"),
        ("ply\nformat ascii 1.0\nelement vertex -1\n", "'element vertex -1'"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\n",
            "'property list uchar int x'",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\n",
            "'property float x'",
        ),
        ("ply\nformat ascii 1.0\nelement vertex 1\n", "no end"),
    ],
)
def test_a_header_of_ply_that_is_not_understood_is_quoted(tmp_path, header, words):
    path = tmp_path / "a.ply"
    path.write_text(header)
    with pytest.raises(ToolError, match=words):
        check_ply(path)


def test_words_among_numbers_are_refused(tmp_path):
    path = write_ply(tmp_path / "a.ply", columns(np.eye(3, dtype=np.float32)), "ascii")
    path.write_text(path.read_text().replace("0.0 1.0 0.0", "0.0 one 0.0"))
    with pytest.raises(ToolError, match=r"a.ply: the points cannot be read: .*one"):
        read_ply(path)


def test_a_compressed_pcd_that_would_grow_without_end_is_refused(tmp_path):
    path = write_pcd(tmp_path / "a.pcd", columns(CLOUD.astype(np.float32)), "binary_compressed")
    header, line, body = path.read_bytes().partition(b"DATA binary_compressed\n")
    points = 300_000_000
    header = header.replace(b"400", str(points).encode())
    sizes = np.array([len(body) - 8, points * 12], "<u4").tobytes()
    path.write_bytes(header + line + sizes + body[8:])
    with pytest.raises(ToolError, match="cannot be 300,000,000 points of 12"):
        check_pcd(path)
