import json

import numpy as np
import pytest
import triquad_client
from support.poses import shifted
from support.recordings.kitti_folder import write_folder
from triquad_tools.commands import evaluate


def _plate(path, x, y, z):
    corners = [[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]]
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    triquad_client.Mesh(np.array(corners, float), faces, epoch=1).save(path)
    return path


def _grid():
    """A level cloud of 2 cm spacing over 4 m x 2 m."""
    x, y = np.meshgrid(np.arange(0.01, 4.0, 0.02), np.arange(0.01, 2.0, 0.02))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def _evaluate(capsys, *arguments):
    assert evaluate.main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_a_plate_scores_its_distance_from_a_cloud(tmp_path, capsys, suffix):
    mesh = _plate(tmp_path / f"plate{suffix}", (0, 4), (0, 2), 0.05)
    cloud = tmp_path / "cloud.ply"
    triquad_client.Mesh(_grid(), np.empty((0, 3), np.int32), epoch=1).save(cloud)
    scores = _evaluate(capsys, mesh, "--reference", cloud)
    assert scores["accuracy_m"] == pytest.approx(0.05, abs=0.002)
    assert scores["completion_m"] == pytest.approx(0.05, abs=0.002)
    assert scores["f_score"] == 1.0
    strict = ("--threshold", 0.04)
    scores = _evaluate(capsys, mesh, "--reference", cloud, *strict)
    assert scores["f_score"] == 0.0


def test_a_plate_scores_its_distance_from_the_scans_of_a_folder(tmp_path, capsys):
    mesh = _plate(tmp_path / "plate.ply", (10, 14), (0, 2), 0.02)
    pose = shifted(10.0)
    bumper = np.array([[0.1, 0.1, 1.0]])
    scan = np.vstack([_grid(), bumper]).astype(np.float32)
    write_folder(tmp_path / "scans", [scan, scan], np.stack([pose, pose]), [0, 1])
    arguments = (mesh, "--reference", tmp_path / "scans")
    scores = _evaluate(capsys, *arguments)
    assert scores["accuracy_m"] == pytest.approx(0.02, abs=0.002)
    assert scores["references"] == 200 * 100 + 1
    assert scores["completion_m"] > 0.02
    scores = _evaluate(capsys, *arguments, "--range-min", 1.5)
    assert scores["references"] < 200 * 100


def test_input_that_cannot_be_used_is_refused(tmp_path, capsys):
    def refusal(*arguments):
        assert evaluate.main([str(argument) for argument in arguments]) == 2
        *before, error = capsys.readouterr().err.splitlines()
        assert all("looking through" in line for line in before)
        assert error.startswith("triquad-eval: ")
        return error

    mesh = _plate(tmp_path / "plate.ply", (0, 1), (0, 1), 0.0)
    cloud = tmp_path / "cloud.ply"
    triquad_client.Mesh(_grid(), np.empty((0, 3), np.int32), epoch=1).save(cloud)
    assert "no such file" in refusal(tmp_path / "no.ply", "--reference", cloud)
    assert "has no faces" in refusal(cloud, "--reference", cloud)
    assert "no.ply" in refusal(mesh, "--reference", tmp_path / "no.ply")
    assert "holds no trajectory" in refusal(mesh, "--reference", tmp_path)
