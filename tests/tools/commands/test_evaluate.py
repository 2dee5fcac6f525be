import json

import numpy as np
import pytest
import triquad_client
from support import servers
from support.recordings.kitti_folder import write_folder
from triquad_tools.commands import evaluate, replay

SCANS = 9
EVERY = 3  # withheld


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
    scores = _evaluate(capsys, "mesh", mesh, "--reference", cloud)["mesh"]
    assert scores["accuracy_m"] == pytest.approx(0.05, abs=0.002)
    assert scores["completion_m"] == pytest.approx(0.05, abs=0.002)
    assert scores["f_score"] == 1.0
    strict = ("--threshold", 0.04)
    scores = _evaluate(capsys, "mesh", mesh, "--reference", cloud, *strict)["mesh"]
    assert scores["f_score"] == 0.0


def test_a_plate_scores_its_distance_from_the_scans_of_a_folder(tmp_path, capsys):
    mesh = _plate(tmp_path / "plate.ply", (10, 14), (0, 2), 0.02)
    pose = np.eye(4)
    pose[0, 3] = 10.0
    bumper = np.array([[0.1, 0.1, 1.0]])
    scan = np.vstack([_grid(), bumper]).astype(np.float32)
    write_folder(tmp_path / "scans", [scan, scan], np.stack([pose, pose]), [0, 1])
    arguments = ("mesh", mesh, "--reference", tmp_path / "scans")
    scores = _evaluate(capsys, *arguments)["mesh"]
    assert scores["accuracy_m"] == pytest.approx(0.02, abs=0.002)
    assert scores["references"] == 200 * 100 + 1
    assert scores["completion_m"] > 0.02
    scores = _evaluate(capsys, *arguments, "--range-min", 1.5)["mesh"]
    assert scores["references"] < 200 * 100


@pytest.fixture(scope="module")
def sphere_folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("sphere")
    clouds = [servers.sphere(6000)] * SCANS
    write_folder(path, clouds, np.tile(np.eye(4), (SCANS, 1, 1)), range(SCANS))
    return path


@pytest.fixture(scope="module")
def server(sphere_folder):
    """A server that has learnt a sphere, but for the withheld scans."""
    with servers.running_service() as endpoint:
        arguments = ["--connect", endpoint, "--skip-every", str(EVERY), "--settle"]
        assert replay.main([str(sphere_folder), *arguments]) == 0
        yield endpoint


def test_a_map_is_scored_at_withheld_scans(server, sphere_folder, tmp_path, capsys):
    withheld = ("--withheld", sphere_folder, "--skip-every", EVERY, "--range-min", 2)
    of_server = _evaluate(capsys, "map", server, *withheld)["withheld"]
    assert of_server["points"] == SCANS // EVERY * 6000
    assert of_server["surface_ratio"] > 0.99
    assert of_server["sdf_median_m"] < 0.1
    file = tmp_path / "map.triquad"
    with triquad_client.connect(server) as client:
        client.download_map(file)
    of_file = _evaluate(capsys, "map", file, *withheld)["withheld"]
    assert of_file["surface_ratio"] == pytest.approx(of_server["surface_ratio"], abs=0.001)
    assert of_file["sdf_median_m"] == pytest.approx(of_server["sdf_median_m"], abs=0.002)
    everything = _evaluate(capsys, "map", file, "--withheld", sphere_folder)["withheld"]
    assert everything["points"] == SCANS * 6000
    none = _evaluate(capsys, "map", file, *withheld, "--range-max", 3)["withheld"]
    assert none["points"] == 0
    assert none["sdf_median_m"] is None


def test_input_that_cannot_be_used_is_refused(tmp_path, capsys, sphere_folder):
    def refusal(*arguments):
        assert evaluate.main([str(argument) for argument in arguments]) == 2
        *before, error = capsys.readouterr().err.splitlines()
        assert all("looking through" in line for line in before)
        assert error.startswith("triquad-eval: ")
        return error

    mesh = _plate(tmp_path / "plate.ply", (0, 1), (0, 1), 0.0)
    cloud = tmp_path / "cloud.ply"
    triquad_client.Mesh(_grid(), np.empty((0, 3), np.int32), epoch=1).save(cloud)
    assert "no such file" in refusal("mesh", tmp_path / "no.ply", "--reference", cloud)
    assert "has no faces" in refusal("mesh", cloud, "--reference", cloud)
    assert "no.ply" in refusal("mesh", mesh, "--reference", tmp_path / "no.ply")
    assert "holds no trajectory" in refusal("mesh", mesh, "--reference", tmp_path)
    missing = tmp_path / "no.triquad"
    assert "no such file" in refusal("map", missing, "--withheld", sphere_folder)
    assert "plate.ply" in refusal("map", mesh, "--withheld", sphere_folder)
    far_apart = ("map", mesh, "--withheld", sphere_folder, "--skip-every", SCANS + 1)
    assert f"--skip-every {SCANS + 1} withholds none of its {SCANS} scans" in refusal(*far_apart)


def test_a_server_that_cannot_be_reached_is_a_failure(capsys, sphere_folder):
    endpoint = servers.free_endpoint()
    assert evaluate.main(["map", endpoint, "--withheld", str(sphere_folder)]) == 1
    assert f"triquad-eval: cannot connect to {endpoint}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("mesh", "x.ply"),
        ("mesh", "x.ply", "--reference", "y.ply", "--threshold", "0"),
        ("map", "x.triquad"),
        ("map", "x.triquad", "--withheld", "y", "--range-max", "inf"),
    ],
)
def test_wrong_usage_ends_with_code_2(arguments):
    with pytest.raises(SystemExit) as caught:
        evaluate.main(arguments)
    assert caught.value.code == 2
