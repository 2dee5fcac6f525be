import json
import struct

import numpy as np
import pytest
from triquad_client import InvalidInputError, Mesh

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


def read_glb(data: bytes) -> tuple[dict, bytes]:
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    if len(data) == 20 + size:
        return document, b""
    length, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    return document, data[28 + size : 28 + size + length]


def test_glb_puts_the_vertices_back_with_y_upwards(tmp_path):
    MESH.save(tmp_path / "mesh.glb")
    document, binary = read_glb((tmp_path / "mesh.glb").read_bytes())
    local = np.frombuffer(binary[:48], "<f4").reshape(4, 3)
    matrix = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    placed = local @ matrix[:3, :3].T + matrix[:3, 3]
    x, y, z = MESH.vertices.T
    assert np.allclose(placed, np.stack([x, z, -y], axis=1), rtol=0, atol=1e-6)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    assert np.array_equal(np.frombuffer(binary[48:], "<u4").reshape(4, 3), MESH.faces)
    assert document["buffers"][0]["byteLength"] == len(binary)


@pytest.mark.parametrize("name", ["mesh.glb", "mesh.ply"])
def test_other_programs_read_the_files(tmp_path, name):
    trimesh = pytest.importorskip("trimesh")
    MESH.save(tmp_path / name)
    mesh = trimesh.load(tmp_path / name, force="mesh")
    assert len(mesh.faces) == 4
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1.0)


def test_empty_meshes_are_files_too(tmp_path):
    EMPTY.save(tmp_path / "mesh.ply")
    EMPTY.save(tmp_path / "mesh.GLB")
    document, binary = read_glb((tmp_path / "mesh.GLB").read_bytes())
    assert binary == b""
    assert "meshes" not in document


def test_other_names_are_refused(tmp_path):
    with pytest.raises(InvalidInputError, match=r"\.ply or \.glb"):
        MESH.save(tmp_path / "mesh.obj")
