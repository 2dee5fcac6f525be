from pathlib import Path

import numpy as np
import pytest
from triquad_client import Mesh
from triquad_tools.console.command import ToolError
from triquad_tools.mapfiles.meshfile import read_mesh

TETRAHEDRON = Mesh(
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32),
    epoch=1,
)


def test_ply_round_trip_keeps_the_precision(tmp_path: Path) -> None:
    vertices = TETRAHEDRON.vertices + 1e5 + 0.123456789
    Mesh(vertices, TETRAHEDRON.faces, epoch=1).save(tmp_path / "a.ply")
    read = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.vertices, vertices)
    np.testing.assert_array_equal(read.faces, TETRAHEDRON.faces)


@pytest.mark.parametrize("name", ["a.gltf", "a", "a.pkl"])
def test_other_formats_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ToolError, match=r"\.ply, \.glb, \.obj, \.stl"):
        read_mesh(tmp_path / name)


def test_files_that_are_no_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ToolError, match="no such file"):
        read_mesh(tmp_path / "missing.ply")
    for name in ("broken.ply", "broken.glb"):
        (tmp_path / name).write_bytes(b"this is not a mesh")
        with pytest.raises(ToolError, match="cannot be read as a mesh"):
            read_mesh(tmp_path / name)
    cut = tmp_path / "cut.ply"
    TETRAHEDRON.save(cut)
    cut.write_bytes(cut.read_bytes()[:-7])
    with pytest.raises(ToolError, match="cannot be read as a mesh"):
        read_mesh(cut)
