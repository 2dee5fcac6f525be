"""Meshes that ``triquad-pack`` writes, opened by the libraries that people use."""

import re
from contextlib import suppress

import numpy as np
import pytest
import trimesh
from support.files.mapfile_edit import file_bytes
from support.maps.exact_maps import exact_map, table
from support.maps.map_records import random_record
from support.maps.small_world import settled_epoch
from triquad_format.mapfile.reader import read_map
from triquad_map.composition.composed_view import RecordedView
from triquad_tools.commands.pack import main
from triquad_tools.mapfiles.crop import crop_record
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.mapping.output import write_output

BOX = ["0.1", "-4.7", "-2", "12.3", "4.1", "3"]
LOW, HIGH = np.array([0.1, -4.7, -2]), np.array([12.3, 4.1, 3])


@pytest.fixture(scope="module")
def map_file(tmp_path_factory):
    """A street; its regions are learnt, and a part of them is kept."""
    record = settled_epoch(4).record()
    path = tmp_path_factory.mktemp("street") / "street.triquad"
    path.write_bytes(file_bytes(crop_record(record, [-5, -10, -3], [40, 10, 5])))
    return path


def export(map_file, tmp_path, name, *options):
    out = tmp_path / name
    assert main([str(map_file), str(out), *options]) == 0
    assert [path.name for path in tmp_path.iterdir()] == [name]
    return out


def test_meshes_lie_on_the_surface(map_file, tmp_path):
    ply = read_mesh(export(map_file, tmp_path, "mesh.ply"))
    (tmp_path / "mesh.ply").unlink()
    glb = read_mesh(export(map_file, tmp_path, "mesh.glb"))
    assert len(ply.faces) > 10_000
    np.testing.assert_array_equal(ply.faces, glb.faces)
    np.testing.assert_allclose(ply.vertices, glb.vertices, atol=1e-4)
    answer = RecordedView(read_map(map_file)).query(ply.vertices)
    assert np.quantile(np.abs(answer.sdf), 0.95) < 0.01
    mesh = trimesh.Trimesh(ply.vertices, ply.faces, process=False)
    assert len(mesh.edges_unique) < 2 * len(ply.faces)  # tiles are joined


def test_holes_are_filled_and_marked_where_that_is_asked_for(map_file, tmp_path, capsys):
    out = export(map_file, tmp_path, "mesh.ply", "--fill", "0.5", "--cell", "0.2", "--crop", *BOX)
    told = re.search(r"([\d,]+) faces, ([\d,]+) of them filled", capsys.readouterr().out)
    faces, filled = (int(number.replace(",", "")) for number in told.groups())
    raw = trimesh.load(out, process=False).metadata["_ply_raw"]["face"]["data"]
    assert len(raw) == faces
    assert 0 < raw["filled"].sum() == filled < faces / 2


@pytest.mark.parametrize("name", ["crop.triquad", "crop.ply"])
def test_of_a_box_in_which_there_is_nothing_nothing_is_written(map_file, tmp_path, name, capsys):
    box = ["--crop", "9000", "0", "0", "9001", "1", "1"]
    assert main([str(map_file), str(tmp_path / name), *box]) == 1
    assert "nothing of the map lies in the box of --crop" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_mesh_without_faces_is_not_written(map_file, tmp_path, capsys):
    air = ["--crop", "4", "-0.5", "1.5", "5", "0.5", "2"]
    assert main([str(map_file), str(tmp_path / "air.ply"), *air]) == 1
    assert "no surface was seen in the box of --crop" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_map_that_has_seen_nothing(tmp_path, capsys):
    source = tmp_path / "in.triquad"
    source.write_bytes(file_bytes(crop_record(random_record(1), [7.9] * 3, [7.95] * 3)))
    assert main([str(source), str(tmp_path / "out.ply")]) == 0
    assert " 0 faces" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["plan.yaml", "tree.bt", "grid.npz"])
def test_a_recording_becomes_what_is_made_of_its_map(tmp_path, name):
    source, out = tmp_path / "in.triquad", tmp_path / name
    source.write_bytes(file_bytes(exact_map(table(0.1, 1.1))))
    written = write_output(read_map(source), out, cell_m=0.05, training=False)
    data = out.read_bytes()
    assert f"{len(data):,} bytes" in written or "cells of 0.1 m" in written
    assert main([str(source), str(out), "--force"]) == 0
    assert out.read_bytes() == data


def test_refusals(map_file, tmp_path, capsys):
    def refused(text, name, *options):
        out = tmp_path / name
        with suppress(SystemExit):  # by the parser of arguments
            assert main([str(map_file), str(out), *options]) == 2
        assert text in capsys.readouterr().err.splitlines()[-1]
        assert list(tmp_path.iterdir()) == []

    refused("'0.001' is not a number in range: use 0.01 to 10", "mesh.ply", "--cell", "0.001")
    refused(".triquad, .ply, .glb, .obj, .stl, .png", "mesh.gltf")
    refused("--fill is of what can mark it, .ply, .glb, .obj, .png", "a.stl", "--fill", "1")
    refused("'6' is not a number in range: use 0 to 5", "mesh.ply", "--fill", "6")
    refused("of map files", "mesh.ply", "--max-error", "0.002")
    refused("nowhere is not a folder", "nowhere/mesh.ply")
