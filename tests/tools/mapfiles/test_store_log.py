import json

import pytest
from support.checkpoint_folder import FIRST, SECOND, write_checkpoints
from support.map_records import random_record
from support.mapfile_edit import file_bytes
from triquad_format.mapfile.protections import Protection, Protections, write_protections
from triquad_format.mapfile.reader import read_map_file
from triquad_tools.commands.inspect import main
from triquad_tools.commands.pack import main as pack

EPOCHS = (9, 12, 15)


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "store" / "lab"
    path.mkdir(parents=True)
    write_checkpoints(path, EPOCHS)
    (path / "lock").touch()
    return path


def log_of(folder, capsys):
    status = main([str(folder), "--log", "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_table(folder, capsys):
    assert main([str(folder), "--log"]) == 0
    lines = capsys.readouterr().out.splitlines()
    size = sum(path.stat().st_size for path in folder.glob("*.triquad"))
    assert lines[0] == f"{folder}: 3 checkpoints, {size:,} bytes"
    rows = [line.split() for line in lines[2:]]
    assert [row[:3] for row in rows] == [
        ["15", "2026-01-31T14:00:00Z", "delta"],
        ["12", "2026-01-31T13:00:00Z", "delta"],
        ["9", "2026-01-31T12:00:00Z", "complete"],
    ]
    assert [row[-1] for row in rows] == ["yes"] * 3


def test_figures_are_those_of_the_files(folder, capsys):
    status, log = log_of(folder, capsys)
    assert status == 0
    assert log["bytes"] == sum(found["bytes"] for found in log["checkpoints"])
    for found in log["checkpoints"]:
        file = read_map_file(folder / found["file"])
        assert (found["bytes"], found["epoch"]) == (file.size, file.record.epoch)
        assert found["problem"] is None
    assert [found["complete"] for found in log["checkpoints"]] == [False, False, True]


def test_a_store_of_one_map_will_do(folder, capsys):
    assert log_of(folder.parent, capsys) == log_of(folder, capsys)


def test_what_lacks_its_base_does_not_open(folder, capsys):
    (folder / "epoch-000000009.triquad").unlink()
    assert main([str(folder), "--log"]) == 1
    captured = capsys.readouterr()
    assert "epoch-000000015.delta.triquad: it needs epoch-000000009.triquad, which is missing" in (
        captured.out
    )
    assert captured.err == "triquad-inspect: 2 of 2 do not open\n"


def test_another_file_in_place_of_the_base_does_not_open(folder, capsys):
    other = random_record(5, indices=(FIRST, SECOND), epoch=9)
    (folder / "epoch-000000009.triquad").write_bytes(file_bytes(other))
    status, log = log_of(folder, capsys)
    assert status == 1
    problems = [found["problem"] for found in log["checkpoints"]]
    assert problems[2] is None
    assert all("not the file that now has this name" in problem for problem in problems[:2])


def test_damaged_ones_are_listed_beside_sound_ones(folder, capsys):
    newest = folder / "epoch-000000015.delta.triquad"
    newest.write_bytes(newest.read_bytes()[:-100])
    status, log = log_of(folder, capsys)
    assert status == 1
    damaged, *sound = log["checkpoints"]
    assert (damaged["epoch"], damaged["time"]) == (15, None)
    assert damaged["problem"]
    assert all(found["problem"] is None for found in sound)


@pytest.mark.parametrize("name", ["empty", "none", "file.triquad"])
def test_what_is_no_folder_of_checkpoints_is_one_line(tmp_path, name, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.triquad").write_bytes(file_bytes(random_record(1)))
    assert main([str(tmp_path / name), "--log"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert name in captured.err


def test_what_was_set_aside_is_named(folder, tmp_path, capsys):
    newest = folder / "epoch-000000015.delta.triquad"
    damaged = newest.with_name(newest.name + ".damaged")
    newest.rename(damaged)
    assert main([str(folder), "--log"]) == 0
    assert f"{damaged.name}: set aside as damaged" in capsys.readouterr().out
    assert pack([str(folder), str(tmp_path / "out.triquad")]) == 0
    assert f"{damaged} is newer, but damaged" in capsys.readouterr().out
    assert pack([str(damaged), str(tmp_path / "saved.triquad"), "--recover"]) == 0
    assert read_map_file(tmp_path / "saved.triquad").record.epoch == 15


def test_what_is_protected_is_named_with_the_reason(folder, capsys):
    protected = Protections(checkpoints=(Protection(12, 5.0, "before\x1b a reset"),))
    write_protections(folder, protected)
    assert main([str(folder), "--log"]) == 0
    out = capsys.readouterr().out
    assert "  epoch-000000012.delta.triquad: protected, before" in out
    assert "\x1b" not in out
    _, log = log_of(folder, capsys)
    assert [one["protected"] is not None for one in log["checkpoints"]] == [False, True, False]
