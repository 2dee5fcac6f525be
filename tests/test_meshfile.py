from pathlib import Path

import numpy as np
import pytest
from triquad_tools.errors import MeshFileError
from triquad_tools.meshfile import Mesh, ply_bytes, read_mesh, write_mesh

TETRAHEDRON = Mesh(
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
)


def test_bytes_of_a_ply_file() -> None:
    mesh = Mesh(np.array([[0.0, 1.0, -2.0]], np.float32), np.array([[0, 0, 0]]))
    header = (
        b"ply\nformat binary_little_endian 1.0\ncomment triquad\nelement vertex 1\n"
        b"property float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = bytes.fromhex("00000000 0000803f 000000c0 03 00000000 00000000 00000000")
    assert ply_bytes(mesh) == header + body


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_ply_round_trip_keeps_the_precision(tmp_path: Path, kind: type) -> None:
    vertices = (TETRAHEDRON.vertices + 1e5 + 0.123456789).astype(kind)
    write_mesh(tmp_path / "a.ply", Mesh(vertices, TETRAHEDRON.faces))
    read = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.vertices, vertices)
    np.testing.assert_array_equal(read.faces, TETRAHEDRON.faces)


def test_ply_without_faces_is_a_cloud(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    write_mesh(tmp_path / "cloud.ply", Mesh(points, np.empty((0, 3), np.int32)))
    read = read_mesh(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(read.vertices, points)
    assert read.faces.shape == (0, 3)


def test_glb_round_trip_and_its_upright_axis(tmp_path: Path) -> None:
    import trimesh

    write_mesh(tmp_path / "a.glb", TETRAHEDRON)
    read = read_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(read.vertices, TETRAHEDRON.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, TETRAHEDRON.faces)
    raw = trimesh.load_scene(tmp_path / "a.glb").to_geometry()
    np.testing.assert_allclose(raw.bounds[1], [1.0, 3.0, 0.0], atol=1e-6)  # up is y in glTF
    assert raw.volume == pytest.approx(1.0)  # and nothing is mirrored


@pytest.mark.parametrize("name", ["a.obj", "a", "a.pkl"])
def test_other_formats_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(MeshFileError, match=r"\.ply or \.glb"):
        write_mesh(tmp_path / name, TETRAHEDRON)
    with pytest.raises(MeshFileError, match=r"\.ply or \.glb"):
        read_mesh(tmp_path / name)


def test_files_that_are_no_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match="no such file"):
        read_mesh(tmp_path / "missing.ply")
    for name in ("broken.ply", "broken.glb"):
        (tmp_path / name).write_bytes(b"this is not a mesh")
        with pytest.raises(MeshFileError, match="cannot be read as a mesh"):
            read_mesh(tmp_path / name)
    cut = ply_bytes(TETRAHEDRON)[:-7]
    (tmp_path / "cut.ply").write_bytes(cut)
    with pytest.raises(MeshFileError, match="cannot be read as a mesh"):
        read_mesh(tmp_path / "cut.ply")


def test_meshes_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshFileError, match="without faces"):
        write_mesh(tmp_path / "a.glb", Mesh(TETRAHEDRON.vertices, np.empty((0, 3), int)))
    with pytest.raises(MeshFileError, match="not int64"):
        ply_bytes(Mesh(np.zeros((1, 3), np.int64), np.empty((0, 3), int)))
