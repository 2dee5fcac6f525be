"""Tools say where things are in the coordinates of the scans, however large these are."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from support.files.file_damage import first_chunk, flipped
from support.files.mapfile_edit import file_bytes
from support.maps.exact_maps import exact_map, flat, table
from support.maps.map_records import assert_same, random_record
from triquad_format.mapfile.parts.part import EVIDENCE
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_map.preview import previews_of
from triquad_tools.commands import inspect, pack
from triquad_tools.mapfiles.crop import crop_record
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.mapfiles.recovery import recover

FAR = (450_000.0, 5_400_000.0, 400.0)


def far(record: MapRecord) -> MapRecord:
    return replace(record, origin_m=FAR)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "far.triquad"
    write_map(far(exact_map(flat(0.1))), path, feature_dtype="<f4")
    return path


def test_what_is_shown(path: Path, capsys) -> None:
    assert inspect.main([str(path)]) == 0
    assert "450000 5400000 400 m" in capsys.readouterr().out
    assert inspect.main([str(path), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    (region,) = shown["regions"]
    assert shown["origin_m"] == region["centre_m"] == list(FAR)
    low, high = np.array(region["evidence_box_m"]) - FAR
    assert ((low[:2] > -12.0) & (low[:2] <= -10.0)).all()
    assert high[2] < 5.0


def test_what_is_cropped_and_written(path: Path, tmp_path: Path, capsys) -> None:
    low, high = np.subtract(FAR, 2.0), np.add(FAR, 2.0)
    box = ["--crop", *(f"{side:.3f}" for side in (*low, *high))]
    assert pack.main([str(path), str(tmp_path / "crop.triquad"), *box]) == 0
    whole, cropped = read_map(path), read_map(tmp_path / "crop.triquad")
    assert cropped.origin_m == FAR
    assert_same(cropped, crop_record(whole, low, high))
    near = crop_record(replace(whole, origin_m=(0.0, 0.0, 0.0)), [-2] * 3, [2] * 3)
    assert_same(cropped, far(near))
    for name in ("mesh.ply", "mesh.glb", "mesh.obj"):
        assert pack.main([str(path), str(tmp_path / name), *box]) == 0
        vertices = read_mesh(tmp_path / name).vertices if name != "mesh.obj" else _obj(tmp_path)
        off = vertices - FAR
        assert np.abs(off[:, 2] - 0.1).max() < 1e-3
        assert 1.9 < np.abs(off[:, :2]).max() < 2.2
    assert pack.main([str(path), str(tmp_path / "picture.png")]) == 0


def _obj(folder: Path) -> np.ndarray:
    lines = (folder / "mesh.obj").read_text().splitlines()
    return np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)


def test_what_changed(path: Path, tmp_path: Path, capsys) -> None:
    """Also between a map far away and one that has the same coordinates without an origin."""
    other = tmp_path / "other.triquad"
    write_map(far(exact_map(table(0.1, 1.1))), other)
    assert inspect.main([str(path), str(other), "--diff", "--json"]) == 0
    objects = json.loads(capsys.readouterr().out)["objects"]
    (appeared,) = objects["appeared"]
    middle = np.add(appeared["low_m"], appeared["high_m"]) / 2 - FAR
    np.testing.assert_allclose(middle, [0, 0, 1.1], atol=0.1)
    near = tmp_path / "near.triquad"
    write_map(exact_map(flat(0.1)), near)
    assert inspect.main([str(path), str(near), "--diff", "--json"]) == 0
    total = json.loads(capsys.readouterr().out)["total"]
    assert total["newly_seen"] == total["points_b"] > 0
    assert total["no_longer_known"] == total["points_a"]


def test_what_is_lost(tmp_path: Path) -> None:
    boxes = []
    for name, record in (("near", random_record(1)), ("far", far(random_record(1)))):
        data = file_bytes(record)
        broken = tmp_path / name
        broken.write_bytes(flipped(data, first_chunk(data, EVIDENCE).middle))
        recovered = recover(broken)
        assert recovered.record.origin_m == record.origin_m
        boxes.append(np.array([(loss.minimum, loss.maximum) for loss in recovered.losses]))
    np.testing.assert_allclose(boxes[1] - FAR, boxes[0])
    assert len(boxes[0])


def test_a_preview_is_in_its_place() -> None:
    (part,) = previews_of(far(exact_map(flat(0.1)))).parts.values()
    (entity,) = SceneUpdate.FromString(part.payload).entities
    (triangles,) = entity.triangles
    place = triangles.pose.position
    assert (place.x, place.y, place.z) == FAR
    assert np.abs([point.z for point in triangles.points]).max() < 1.0
