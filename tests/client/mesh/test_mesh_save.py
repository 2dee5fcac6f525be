import dataclasses
import io
import struct
import sys

import numpy as np
import pytest
import trimesh
from triquad_client import InvalidInputError, Mesh
from triquad_client.mesh.mesh_files import GlbMesh, glb_bytes

FAR = np.array([500_000.25, 4_000_000.5, 10.125])
MESH = Mesh(
    FAR + np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
    epoch=4,
)
EMPTY = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), epoch=1)


def test_ply_is_exact(tmp_path):
    MESH.save(tmp_path / "mesh.ply")
    header, body = (tmp_path / "mesh.ply").read_bytes().split(b"end_header\n")
    assert header.splitlines()[:2] == [b"ply", b"format binary_little_endian 1.0"]
    assert b"element vertex 4" in header
    assert b"element face 4" in header
    assert np.array_equal(np.frombuffer(body[:96], "<f8").reshape(4, 3), MESH.vertices)
    assert body[96:109] == b"\x03" + struct.pack("<3i", 0, 2, 1)
    assert len(body) == 96 + 4 * 13


def test_glb_puts_the_vertices_back_with_y_upwards(tmp_path):
    MESH.save(tmp_path / "mesh.glb")
    scene = trimesh.load_scene(tmp_path / "mesh.glb")
    (name,) = scene.graph.nodes_geometry
    matrix, geometry = scene.graph[name]
    local = scene.geometry[geometry].vertices
    assert np.abs(local).max() < 2, "single precision is exact there"
    x, y, z = MESH.vertices.T
    placed = local @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(placed, np.stack([x, z, -y], axis=1), rtol=0, atol=1e-6)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)


MARKED = dataclasses.replace(MESH, filled=np.array([False, True, False, True]))


def test_ply_marks_the_faces_that_fill_holes():
    data = MARKED.file_bytes(".ply")
    assert b"uchar int vertex_indices\nproperty uchar filled\nend_header\n" in data
    faces = np.frombuffer(data[-4 * 14 :], np.uint8).reshape(4, 14)
    assert faces[:, -1].tolist() == [0, 1, 0, 1]
    read = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
    np.testing.assert_array_equal(read.faces, MESH.faces)


def test_glb_holds_two_meshes():
    scene = trimesh.load_scene(io.BytesIO(MARKED.file_bytes(".glb")), file_type="glb")
    assert {name: len(part.faces) for name, part in scene.geometry.items()} == {
        "seen": 2,
        "filled": 2,
    }
    y_up = FAR[[0, 2, 1]] * (1, 1, -1)
    np.testing.assert_allclose(scene.bounds - y_up, [(0, 0, -2), (1, 3, 0)], rtol=0, atol=1e-6)


def test_a_glb_with_colours_holds_them_as_they_are():
    colours = np.array([[0.0, 0.5, 1.0], [1.5, 0.2, -0.1], [0.1, 0.2, 0.3], [1.0, 1.0, 1.0]])
    data = glb_bytes([GlbMesh("ball", MESH.vertices - FAR, MESH.faces, colours)])
    (read,) = trimesh.load(io.BytesIO(data), file_type="glb", process=False).geometry.values()
    np.testing.assert_array_equal(read.vertices, MESH.vertices - FAR)
    np.testing.assert_array_equal(read.faces, MESH.faces)
    np.testing.assert_allclose(read.visual.vertex_attributes["color"][:, :3], colours, atol=1e-7)


def test_obj_holds_two_objects():
    _, seen, filled = MARKED.file_bytes(".obj").decode().split("\no ")
    for name, part in (("seen", seen), ("filled", filled)):
        lines = part.splitlines()
        assert lines[0] == name
        assert sum(line.startswith("f ") for line in lines) == 2


def test_an_stl_cannot_mark_them():
    with pytest.raises(InvalidInputError, match=r"use \.ply, \.glb or \.obj"):
        MARKED.file_bytes(".stl")


@pytest.mark.parametrize("name", ["mesh.glb", "mesh.ply", "mesh.obj", "mesh.stl"])
def test_other_programs_read_the_files(tmp_path, name):
    near = Mesh(MESH.vertices - FAR, MESH.faces, epoch=MESH.epoch)
    near.save(tmp_path / name)
    mesh = trimesh.load_mesh(tmp_path / name)
    assert len(mesh.faces) == 4
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1.0)


@pytest.mark.parametrize("suffix", [".ply", ".GLB", ".obj", ".stl"])
def test_empty_meshes_are_files_too(tmp_path, suffix):
    EMPTY.save(tmp_path / f"mesh{suffix}")
    scene = trimesh.load_scene(io.BytesIO(EMPTY.file_bytes(suffix)), file_type=suffix[1:].lower())
    assert sum(len(getattr(geometry, "faces", ())) for geometry in scene.geometry.values()) == 0


def test_other_names_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"'\.las': use one of \.ply, \.glb, \.obj, \.stl"):
        MESH.save(tmp_path / "mesh.las")


def test_without_trimesh_ply_and_glb_are_written_and_the_others_name_the_remedy(
    tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    for name in ("mesh.ply", "mesh.glb"):
        MESH.save(tmp_path / name)
    with pytest.raises(InvalidInputError, match=r"pip install 'triquad\[mesh\]'"):
        MESH.save(tmp_path / "mesh.obj")
    assert not (tmp_path / "mesh.obj").exists()
