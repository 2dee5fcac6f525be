"""The experiments of the paper run from outside, on a folder of scans."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.maps import small_world
from support.recordings.kitti_folder import write_folder
from triquad_client import Mesh
from triquad_tools.commands.evaluate import main
from triquad_tools.paper import other_mappers

SCANS = 12
QUICK = ("--samples", "400000", "--mesh-samples", "300000", "--spacing", "0.05")
LITTLE = ("--set", "training.samples_per_ray=8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("paper")
    scans = small_world.world(SCANS).scans
    poses = np.array([scan.world_from_sensor for scan in scans])
    stamps = [10**18 + number * 10**8 for number in range(SCANS)]
    write_folder(path / "street", [scan.points for scan in scans], poses, stamps)
    hits = small_world.world(SCANS).hits
    Mesh(hits, np.zeros((0, 3), np.int32), None).save(path / "truth.ply")
    return path


def words(folder: Path, output: Path, *more: str) -> list[str]:
    named = ["--reference", str(folder / "truth.ply"), "--style", "maicity"]
    return ["paper", str(folder / "street"), str(output), *named, *QUICK, *LITTLE, *more]


def test_all_experiments_are_reported_beside_the_published(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "report"
    assert main(words(folder, output, "--every", "1", "--as-published")) == 0
    page, figures = (
        (output / "report.md").read_text(),
        json.loads((output / "report.json").read_text()),
    )
    assert page in capsys.readouterr().out
    for name in ("sparse.png", "holes.png", "memory.png"):
        assert name in page
        assert (output / name).stat().st_size > 10_000
    runs = figures["runs"]
    found = {(run["method"], run["every"], run["encoding"]) for run in runs}
    wanted = {(1, "both"), (5, "both"), (5, "features"), (5, "fourier")}
    assert found >= {(name, *one) for name in ("triquad", "as published") for one in wanted}
    whole = {(run["method"], run["every"]): run for run in runs if run["encoding"] == "both"}
    for method in ("triquad", "as published"):
        dense, few = (whole[method, every] for every in (1, 5))
        assert dense["scans"] == SCANS
        assert few["scans"] == 3
        assert few["samples"] >= 100_000
        assert dense["parameters"] > few["parameters"] > 100_000
    dense, few = (whole["triquad", every]["scores"] for every in (1, 5))
    assert dense["completion_ratio"] > 0.95 > few["completion_ratio"]
    assert whole["as published", 1]["scores"]["completion_ratio"] > 0.5
    assert "| 3QFP | published | 1,270,000 | 2.68 | 1.52 |" in page
    memory = figures["memory"]
    assert memory[-1]["scans"] == SCANS
    assert memory[-1]["parameters"] == whole["triquad", 1]["parameters"]


def test_what_cannot_be_used_is_told(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "report"
    assert main(words(folder, output, "--every", "40")) == 2
    assert "12 scans, and 201 are needed" in capsys.readouterr().err
    assert not output.exists()
    assert main(words(folder, tmp_path)) == 2
    assert "exists: give the name of a new folder" in capsys.readouterr().err


def test_depth_images_show_each_point_where_its_camera_sees_it() -> None:
    """What Open3D is given of a scan: the faces of a cube."""
    ends = np.random.default_rng(0).normal(size=(300, 3)) * 10
    np.testing.assert_allclose(np.linalg.det(other_mappers.FACES), 1.0)
    seen = np.zeros(len(ends), int)
    for face in other_mappers.FACES:
        for number, end in enumerate(ends @ face.T):
            image = other_mappers.depth_image(end[None])
            rows, columns = np.nonzero(image)
            if not len(rows):
                continue
            half = image.shape[0] / 2 - 1
            assert image[rows[0], columns[0]] == pytest.approx(end[2])
            across = (np.array([columns[0], rows[0]]) + 0.5 - half - 1) / half
            np.testing.assert_allclose(across, end[:2] / end[2], atol=0.51 / half)
            seen[number] += 1
    assert (seen >= 1).all()
