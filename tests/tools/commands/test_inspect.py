import dataclasses
import json
import re

import numpy as np
import pytest
from support.files.checkpoint_folder import write_checkpoints
from support.maps.exact_maps import SEEN_M, exact_map, flat
from support.maps.map_records import random_record, with_region
from triquad_format.mapfile.writer import write_map
from triquad_format.records import morton
from triquad_format.records.replay_rays import STEPS, ReplayRays, are_held_out
from triquad_tools.commands.inspect import main


@pytest.fixture
def map_file(tmp_path):
    path = tmp_path / "map.triquad"
    write_map(random_record(1, indices=((0, 0, 0), (-1, 0, 0))), path)
    return path


@pytest.fixture
def checkpoint(tmp_path):
    return write_checkpoints(tmp_path, (9, 12))[1]


def summary_of(path, capsys):
    assert main([str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_text(map_file, capsys):
    assert main([str(map_file)]) == 0
    out = capsys.readouterr().out
    for text in (
        "epoch 7",
        "format version  1",
        "/triquad/vertices",
        "(float16)",
        "leaf_m 0.25",
        "training state  yes",
    ):
        assert text in out


def test_json(map_file, capsys):
    assert main([str(map_file), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    record = random_record(1, indices=((0, 0, 0), (-1, 0, 0)))
    tables = [table for region in record.regions for table in region.tables]
    assert report["bytes"] == map_file.stat().st_size
    assert report["vertices"] == sum(len(table.codes) for table in tables)
    mlp = record.regions[0].mlp
    dense = 2 * sum(array.size for array in (*mlp.weights, *mlp.biases))
    assert report["parameters"] == dense + sum(table.features.size for table in tables)
    assert report["settings"]["depth"] == 6
    assert report["regions"][1]["index"] == [-1, 0, 0]
    assert report["regions"][1]["centre_m"] == [-12.0, 0.0, 0.0]
    assert report["parts"]["/triquad/vertices"]["parts"] == 6


def ground_with_rays():
    """Flat ground at 0.1 m, above which rays end: by 2 cm, and by 8 cm in one place."""
    record = exact_map(flat(0.1), label_error_m=0.0)
    settings, (region,) = record.settings, record.regions
    x, y = np.random.default_rng(0).uniform(-SEEN_M, SEEN_M, (2, 200_000))
    z = 0.1 + np.where(np.minimum(x, y) > 6.4, 0.08, 0.02)
    leaves = np.stack([x, y, z], axis=1) / settings.leaf_m + (1 << settings.depth)
    ends = np.floor(leaves * STEPS).astype(np.int32)
    ends = ends[np.argsort(morton.encode(ends // STEPS), kind="stable")]
    rays = ReplayRays(
        ends,
        np.zeros(len(ends), np.int32),
        np.full(len(ends), 255, np.uint8),
        origins=np.array([[0, 0, 2]], np.float32),
    )
    return with_region(record, training=dataclasses.replace(region.training, rays=rays))


def test_how_well_a_map_fits_rays_that_it_was_not_trained_on(tmp_path, capsys):
    record = ground_with_rays()
    path = tmp_path / "ground.triquad"
    write_map(record, path)
    fit = summary_of(path, capsys)["fit"]
    assert fit["rays"] == are_held_out(record.regions[0].training.rays.ends).sum()
    assert fit["median_m"] == pytest.approx(0.02, abs=1e-3)
    assert fit["upper_m"] == pytest.approx(0.02, abs=2e-3)
    assert len(fit["worst"]) == 5
    assert fit["worst"][0] == pytest.approx([9.6, 9.6, 3.2])
    assert fit["worst_median_m"][0] == pytest.approx(0.08, abs=1e-3)
    assert fit["worst_median_m"][1] < 0.03
    assert main([str(path)]) == 0
    out = capsys.readouterr().out
    told = rf"held-out rays +within (19|20|21)\.\d mm, 90 % in (19|2\d)\.\d mm, of {fit['rays']:,} "
    assert re.search(told, out)


def test_a_map_without_rays_says_that_there_are_none_to_judge_it_by(map_file, tmp_path, capsys):
    for record, why in (
        (random_record(1, training=False), "no training state"),
        (random_record(1), "no rays among it"),
    ):
        path = tmp_path / "map.triquad"
        write_map(record, path)
        assert summary_of(path, capsys)["fit"] is None
        assert main([str(path)]) == 0
        assert f"none to judge the map by, as there is {why}" in capsys.readouterr().out


def test_volume_is_that_of_the_voxels_that_a_region_answers_for(tmp_path, capsys):
    path = tmp_path / "ground.triquad"
    write_map(exact_map(flat(0.1)), path)
    report = summary_of(path, capsys)
    layer_m3 = (2 * SEEN_M) ** 2 * 0.2
    assert report["surface_m3"] == pytest.approx(layer_m3)
    assert report["free_m3"] == pytest.approx(10 * layer_m3)

    overlapping = tmp_path / "overlapping.triquad"
    write_map(random_record(1, indices=((0, 0, 0), (1, 0, 0)), points=4000), overlapping)
    both = summary_of(overlapping, capsys)
    voxels = both["surface_m3"] / 0.25**3
    assert voxels == round(voxels)
    # Of cubes of 64 voxels, 48 along each side are a region's own.
    assert voxels == pytest.approx(2 * 4000 * (48 / 64) ** 3, rel=0.1)


def test_a_checkpoint_is_shown_with_all_its_parts(checkpoint, capsys):
    report = summary_of(checkpoint, capsys)
    assert report["epoch"] == 12
    assert report["metadata"]["created"] == "2026-01-31T13:00:00Z"
    assert report["parts"]["/triquad/evidence"]["parts"] == 2
    stored = sum(part["stored_bytes"] for part in report["parts"].values())
    assert report["bytes"] == checkpoint.stat().st_size + stored


def test_a_checkpoint_without_a_part_is_damaged(checkpoint, capsys):
    for part in (checkpoint.parent / "parts").iterdir():
        part.unlink()
    for options in ([], ["--diff", str(checkpoint)]):
        assert main([str(checkpoint), *options]) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert "parts/" in captured.err


def test_map_without_regions(tmp_path, capsys):
    path = tmp_path / "empty.triquad"
    write_map(random_record(indices=()), path)
    assert main([str(path)]) == 0
    assert "training state  no" in capsys.readouterr().out


def test_faults_are_one_line(map_file, tmp_path, capsys):
    data = map_file.read_bytes()
    for status, content in (
        (1, data[:-9]),
        (1, data[:500] + b"\xff" + data[501:]),
        (1, b""),
        (2, b"another file"),
    ):
        map_file.write_bytes(content)
        assert main([str(map_file)]) == status
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert "map.triquad" in captured.err
    assert main([str(tmp_path / "none.triquad")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "none.triquad: no such f" in line
    assert "Errno" not in line

    assert main([str(tmp_path)]) == 2
    assert "is not a folder of checkpoints" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main([])


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["FILE", "FILE"], "only --diff takes more than one file: 2 given"),
        (["FILE", "--diff"], "--diff compares two map files: 1 given"),
        (["FILE", "--log", "--diff", "FILE"], "exclude each other"),
        (["FILE", "--log", "--plot", "a.png"], "--plot is for map files"),
        (["FILE", "--log"], "is a file: --log lists the checkpoints in a folder"),
    ],
)
def test_wrong_usage_is_one_line(map_file, arguments, complaint, capsys):
    assert main([argument.replace("FILE", str(map_file)) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert complaint in captured.err


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("a.jpg", "its name must end in .png"),
        ("none/a.png", "its folder does not exist"),
        ("taken.png", "it is a folder"),
    ],
)
def test_a_picture_that_cannot_be_written_is_refused(map_file, tmp_path, name, reason, capsys):
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(SystemExit, match="2"):
        main([str(map_file), "--plot", str(tmp_path / name)])
    assert reason in capsys.readouterr().err
