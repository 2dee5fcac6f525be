import json

import pytest
from support.files.checkpoint_folder import map_at, write_checkpoints, write_record
from support.files.mapfile_edit import file_bytes
from support.maps.map_records import random_record
from triquad_format.mapfile.reader import read_map_file
from triquad_format.mapfile.writer import write_map
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
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert lines[0] == f"{folder}: 3 checkpoints, {size:,} bytes"
    rows = [line.split() for line in lines[2:]]
    assert [row[:2] for row in rows] == [
        ["15", "2026-01-31T14:00:00Z"],
        ["12", "2026-01-31T13:00:00Z"],
        ["9", "2026-01-31T12:00:00Z"],
    ]
    assert [row[-1] for row in rows] == ["yes"] * 3


def test_figures_are_those_of_the_files(folder, capsys):
    status, log = log_of(folder, capsys)
    assert status == 0
    for found in log["checkpoints"]:
        file = read_map_file(folder / found["file"])
        assert found["epoch"] == file.record.epoch
        assert found["bytes"] == sum(entry.stored for entry in file.manifest.entries)
        assert found["problem"] is None
    newest, _, oldest = log["checkpoints"]
    assert 0 < newest["new_bytes"] < newest["bytes"]
    assert oldest["new_bytes"] == oldest["bytes"]


def test_a_store_of_one_map_will_do(folder, capsys):
    assert log_of(folder.parent, capsys) == log_of(folder, capsys)


def test_a_backup_among_checkpoints_is_listed(folder, capsys):
    write_map(map_at(20), folder / "epoch-000000020.triquad")
    status, log = log_of(folder, capsys)
    assert status == 0
    assert [found["epoch"] for found in log["checkpoints"]] == [20, 15, 12, 9]


def test_what_lacks_parts_is_told(folder, capsys):
    newest = read_map_file(folder / "epoch-000000015.checkpoint").manifest
    lost = next(entry for entry in newest.entries if entry.epoch == 15)
    (folder / "parts" / lost.name).unlink()
    assert main([str(folder), "--log"]) == 1
    captured = capsys.readouterr()
    total = len(newest.entries)
    assert f"epoch-000000015.checkpoint: 1 of its {total} parts are missing" in captured.out
    assert captured.err == "triquad-inspect: 1 of 3 do not open\n"


def test_damaged_ones_are_listed_beside_sound_ones(folder, capsys):
    newest = folder / "epoch-000000015.checkpoint"
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
    newest = folder / "epoch-000000015.checkpoint"
    damaged = newest.with_name(newest.name + ".damaged")
    newest.rename(damaged)
    assert main([str(folder), "--log"]) == 0
    assert f"{damaged.name}: set aside as damaged" in capsys.readouterr().out
    assert pack([str(folder), str(tmp_path / "out.triquad")]) == 0
    assert f"{damaged} is newer, but damaged" in capsys.readouterr().out
    assert pack([str(damaged), str(tmp_path / "saved.triquad"), "--recover"]) == 0
    assert read_map_file(tmp_path / "saved.triquad").record.epoch == 15


def test_what_is_kept_to_undo_something_is_told(folder, capsys):
    write_record(folder, map_at(20), undoes="a\x1b reset")
    assert main([str(folder), "--log"]) == 0
    out = capsys.readouterr().out
    assert "  epoch-000000020.checkpoint: kept, to undo a" in out
    assert "\x1b" not in out
    _, log = log_of(folder, capsys)
    assert [one["undoes"] for one in log["checkpoints"][1:]] == ["", "", ""]
