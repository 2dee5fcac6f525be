import io
import json
import subprocess
import sys

import pytest
from map_records import random_record
from triquad_format.mapfile import write_map
from triquad_tools.inspect import main


@pytest.fixture
def map_file(tmp_path):
    path = tmp_path / "map.triquad"
    write_map(random_record(1, indices=((0, 0, 0), (-1, 0, 0))), path)
    return path


def test_text(map_file, capsys):
    assert main([str(map_file)]) == 0
    out = capsys.readouterr().out
    for text in ("epoch 7", "regions", "/triquad/vertices", "leaf_m 0.25", "training state  yes"):
        assert text in out
    assert "ok:" not in out


def test_json(map_file, capsys):
    assert main([str(map_file), "--json", "--verify"]) == 0
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
    assert report["regions"][0]["samples"] == 40
    assert report["parts"]["/triquad/vertices"]["parts"] == 12
    assert any("mcap library" in check for check in report["checks"])


def test_verify(map_file, capsys):
    assert main([str(map_file), "--verify"]) == 0
    assert capsys.readouterr().out.count("  ok: ") == 6


def test_map_without_regions(tmp_path, capsys):
    path = tmp_path / "empty.triquad"
    write_map(random_record(indices=()), path)
    assert main([str(path), "--verify"]) == 0
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
        assert main([str(map_file), "--verify"]) == status
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.count("\n") == 1
        assert "map.triquad" in captured.err
    assert main([str(tmp_path / "none.triquad")]) == 2
    assert "none.triquad" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main([])


def test_no_state_left_on_streams():
    stream = io.BytesIO(b"before")
    stream.seek(6)
    write_map(random_record(2), stream)
    assert stream.getvalue().startswith(b"before\x89MCAP")


def test_format_needs_neither_server_nor_torch():
    code = (
        "import sys, triquad_format.mapfile, triquad_format.evaluator, triquad_format.crop\n"
        "bad = {'torch', 'numba', 'zenoh', 'skimage', 'triquad_server'} & set(sys.modules)\n"
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
