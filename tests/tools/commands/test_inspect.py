import json

import pytest
from support.files.checkpoint_folder import write_checkpoints
from support.maps.exact_maps import SEEN_M, exact_map, flat
from support.maps.map_records import random_record
from triquad_format.mapfile.writer import write_map
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
    assert "none.triquad" in capsys.readouterr().err
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
