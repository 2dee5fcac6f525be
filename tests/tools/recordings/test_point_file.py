import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.recordings.point_files import (
    PCD_FORMATS,
    PLY_FORMATS,
    columns,
    write_las,
    write_pcd,
    write_ply,
)
from triquad_tools.console.command import ToolError
from triquad_tools.recordings.folders.point_file import read_points

CLOUD = np.round(np.random.default_rng(0).normal(0, 9, (400, 3)))  # so that it can be compressed

FILES = [
    *(("a.ply", form) for form in PLY_FORMATS),
    *(("a.pcd", form) for form in PCD_FORMATS),
    ("a.las", "3"),
    ("a.laz", "7"),
]

singles = arrays(
    np.float32,
    st.tuples(st.integers(1, 20), st.just(3)),
    elements=st.floats(-1e6, 1e6, width=32) | st.just(np.nan) | st.just(np.inf),
)
millimetres = arrays(
    np.int64, st.tuples(st.integers(1, 20), st.just(3)), elements=st.integers(-(10**8), 10**8)
)


def _file(path: Path, form: str, points=CLOUD, dtype="f4", **others) -> Path:
    if path.suffix in (".las", ".laz"):
        return write_las(path, points, int(form))
    write = write_ply if path.suffix == ".ply" else write_pcd
    return write(path, columns(points.astype(dtype), **others), form)


@given(singles, st.sampled_from(FILES[:6]), st.booleans())
def test_points_come_back(tmp_path_factory, points, file, double):
    name, form = file
    path = _file(tmp_path_factory.mktemp("file") / name, form, points, "f8" if double else "f4")
    precision = 1e-6 if form == "ascii" else 0.0  # of what writes here
    np.testing.assert_allclose(read_points(path).points, points, rtol=precision, atol=precision)


@given(millimetres, st.sampled_from(["a.las", "a.laz"]), st.sampled_from(["1", "3", "7"]))
def test_points_of_surveyors_keep_their_millimetres(tmp_path_factory, points, name, form):
    metres = points / 1000.0 + (500_000.0, 5_400_000.0, 300.0)
    path = _file(tmp_path_factory.mktemp("las") / name, form, metres)
    np.testing.assert_allclose(read_points(path).points, metres, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(("name", "form"), FILES[:6])
def test_times_of_points_are_found_among_other_fields(tmp_path, name, form):
    times = np.arange(400, dtype=np.uint32) * 250_000
    path = _file(tmp_path / name, form, t=times, ring=np.arange(400, dtype=np.uint8))
    read = read_points(path)
    np.testing.assert_array_equal(read.times, times)
    np.testing.assert_allclose(read.points, CLOUD, rtol=1e-5)


@pytest.mark.parametrize(("name", "form"), FILES[:6])
def test_headers_of_other_programs_are_understood(tmp_path, name, form):
    """Names in upper case, comments, fields of which there are none, faces after the points."""
    path = _file(tmp_path / name, form, CLOUD, ring=np.arange(400, dtype=np.uint8))
    content = path.read_bytes()
    for axis in (b" x", b" y", b" z"):
        content = content.replace(axis, axis.upper(), 1)
    if name == "a.ply":
        content = content.replace(b"ply\n", b"ply\ncomment TextureFile none.jpg\n", 1)
        content = content.replace(b"element face 0", b"obj_info Z\nelement face 1")
        big = {"binary_big_endian": ">", "binary_little_endian": "<"}.get(form)
        face = np.array([0, 1, 2], f"{big or '<'}i4").tobytes()
        content += b"3 0 1 2\n" if big is None else b"\x03" + face
    else:
        for line, more in ((b"FIELDS", b" none _"), (b"SIZE", b" 2 4"), (b"TYPE", b" U F")):
            at = content.index(b"\n", content.index(line))
            content = content[:at] + more + content[at:]
        at = content.index(b"\n", content.index(b"COUNT"))
        content = content[:at] + b" 0 0" + content[at:]
    path.write_bytes(content)
    np.testing.assert_allclose(read_points(path).points, CLOUD, rtol=1e-5)
    path.write_bytes(re.sub(rb"COUNT.*\n", b"", _file(path, form).read_bytes()))
    np.testing.assert_allclose(read_points(path).points, CLOUD, rtol=1e-5)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_a_file_may_hold_no_points(tmp_path, name):
    form = "binary_little_endian" if name == "a.ply" else "binary"
    read = read_points(_file(tmp_path / name, form, CLOUD[:0]))
    assert read.points.shape == (0, 3)


@pytest.mark.parametrize(("name", "form"), FILES)
def test_a_file_cut_anywhere_is_told(tmp_path, name, form):
    path = _file(tmp_path / name, form)
    whole = path.read_bytes()
    for cut in [0, 3, 20, 90, 300, 1000, len(whole) // 2, len(whole) - 60]:
        path.write_bytes(whole[:cut])
        with pytest.raises(ToolError, match=f"^{re.escape(str(path))}: .*copy it again") as caught:
            read_points(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_a_file_without_z_is_refused(tmp_path, name):
    column = np.zeros(4, np.float32)
    write = write_ply if name == "a.ply" else write_pcd
    path = write(tmp_path / name, {"x": column, "y": column, "height": column})
    words = (
        "no field of name z" if name == "a.ply" else "has no z for its points, only x, y, height"
    )
    with pytest.raises(ToolError, match=words):
        read_points(path)
