import dataclasses
import io
import itertools

import pytest
from mcap.reader import make_reader
from support.files.checkpoint_folder import FIRST, HOUR_NS, START_NS, map_at, write_checkpoints
from support.files.file_damage import first_chunk, flipped
from support.files.mapfile_edit import file_bytes, rewritten
from support.maps.map_records import SMALL, assert_same, random_record
from triquad_format.mapfile.parts.part import REGION, VERTICES, PartKey
from triquad_format.mapfile.reader import read_map, read_map_file
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapProgress
from triquad_tools.commands.pack import main
from triquad_tools.mapfiles.crop import crop_record, without_training
from triquad_tools.mapfiles.recovery import recover

CUBE = tuple(itertools.product((0, 1), repeat=3))


@pytest.fixture
def map_file(tmp_path):
    path = tmp_path / "in.triquad"
    path.write_bytes(file_bytes(random_record(1, indices=CUBE, points=200), preview=True))
    return path


def test_tool_packs(map_file, tmp_path, capsys):
    out = tmp_path / "out.triquad"
    box = ["--crop", "-1", "-1", "-1", "2.5", "2", "2"]
    assert main([str(map_file), str(out), *box]) == 0
    assert "bytes" in capsys.readouterr().out
    assert out.stat().st_size < map_file.stat().st_size / 2
    whole = read_map(map_file)
    assert_same(read_map(out), crop_record(whole, [-1, -1, -1], [2.5, 2, 2]))
    assert main([str(map_file), str(out), "--no-training", "--force"]) == 0
    assert_same(read_map(out), without_training(whole))


def test_a_packed_map_still_tells_what_it_was_made_of(tmp_path):
    record = dataclasses.replace(random_record(1), progress=MapProgress(60, 116_000_000, 0.25))
    write_map(record, tmp_path / "in.triquad")
    out = tmp_path / "out.triquad"
    options = ["--crop", "-4", "-4", "-4", "4", "4", "4"]
    assert main([str(tmp_path / "in.triquad"), str(out), *options]) == 0
    assert read_map(out).progress == record.progress


def test_tool_keeps_precision(tmp_path):
    record = random_record(7, feature_dtype="<f4")
    fine, again = tmp_path / "fine.triquad", tmp_path / "again.triquad"
    fine.write_bytes(file_bytes(record, preview=True, feature_dtype="<f4"))
    assert main([str(fine), str(again)]) == 0
    assert again.read_bytes() == fine.read_bytes()


def test_tool_refuses(map_file, tmp_path, capsys):
    out = tmp_path / "out.triquad"

    def refused(status, text, *arguments):
        assert main([str(a) for a in arguments]) == status
        error = capsys.readouterr().err
        assert text in error
        assert error.count("\n") == 1

    before = map_file.read_bytes()
    link = tmp_path / "link.triquad"
    link.symlink_to(map_file)
    refused(2, "is the input", map_file, map_file, "--force")
    refused(2, "is the input", map_file, link, "--force")
    out.write_bytes(b"precious")
    refused(2, "--force", map_file, out)
    assert out.read_bytes() == b"precious"
    refused(1, "box", map_file, out, "--force", "--crop", *["900", "0", "0", "901", "1", "1"])
    for name in ("out.triquad", "out.ply", "out.png"):
        reversed_box = ["--crop", "1", "0", "0", "0", "1", "1"]
        refused(2, "--crop holds nothing", map_file, tmp_path / name, "--force", *reversed_box)
    refused(2, "no such file", tmp_path / "none", out, "--force")
    broken = tmp_path / "broken"
    broken.write_bytes(before[:-50])
    refused(1, "incomplete", broken, out, "--force")
    assert out.read_bytes() == b"precious"
    assert main([str(map_file), str(out), "--force"]) == 0
    assert map_file.read_bytes() == before
    with pytest.raises(SystemExit, match="2"):
        main([str(map_file)])


def test_tool_reads_only_what_the_box_needs(tmp_path, capsys):
    wide = dataclasses.replace(SMALL, depth=10)
    source, out = tmp_path / "in.triquad", tmp_path / "out.triquad"
    record = random_record(2, settings=wide, points=2000, training=False)
    write_map(record, source)
    box = ["--crop", "-60", "-60", "-60", "-40", "-40", "-40"]
    assert main([str(source), str(out), *box]) == 0
    assert_same(read_map(out), crop_record(record, [-60] * 3, [-40] * 3))
    summary = make_reader(io.BytesIO(source.read_bytes())).get_summary()
    far = summary.chunk_indexes[-2]  # of the last evidence, in the opposite corner
    middle = far.chunk_start_offset + far.chunk_length // 2
    source.write_bytes(flipped(source.read_bytes(), middle))

    assert main([str(source), str(out), *box, "--force"]) == 0
    assert main([str(source), str(out), "--force"]) == 1
    assert "damaged" in capsys.readouterr().err


def test_tool_takes_an_epoch_of_a_store(tmp_path, capsys):
    store, out = tmp_path / "store", tmp_path / "out.triquad"
    (store / "street").mkdir(parents=True)
    write_checkpoints(store / "street", (3, 5, 9))

    def epoch(*options):
        assert main([str(store), str(out), "--force", *options]) == 0
        printed = capsys.readouterr().out.splitlines()[0]
        record = read_map(out)
        assert_same(record, map_at(record.epoch))
        assert printed.startswith(f"epoch {record.epoch}, from {store / 'street'}")
        return record.epoch

    assert epoch() == 9
    assert epoch("--at", "5") == 5
    assert epoch("--at", "8") == 5
    assert epoch("--at", "2026-01-31T13:30:00Z") == 5
    assert read_map_file(out).manifest.stamp_ns == START_NS + HOUR_NS
    assert main([str(store / "street"), str(out), "--at", "2"]) == 2
    assert "no checkpoint of 2 or before" in capsys.readouterr().err
    assert main([str(out), str(tmp_path / "o.triquad"), "--at", "2"]) == 2
    assert "--at asks for a folder" in capsys.readouterr().err
    newest = store / "street" / "epoch-000000009.triquad"
    assert main([str(store), str(newest), "--force"]) == 2
    assert "would pass for a checkpoint" in capsys.readouterr().err
    newest = read_map_file(store / "street" / "epoch-000000009.checkpoint")
    lost = next(e for e in newest.manifest.entries if e.key == PartKey(REGION, FIRST))
    (store / "street" / "parts" / lost.name).unlink()
    assert main([str(store), str(out), "--force"]) == 1
    assert f"parts/{lost.name} is missing" in capsys.readouterr().err
    assert main([str(store), str(out), "--force", "--recover"]) == 1
    assert_same(read_map(out).regions, map_at(9).regions[1:])


def test_tool_refuses_newer_files(map_file, tmp_path, capsys):
    out = tmp_path / "out.triquad"
    newer = rewritten(map_file.read_bytes(), metadata={"min_reader_version": "3"})
    map_file.write_bytes(newer)
    assert main([str(map_file), str(out)]) == 2
    assert "map file version 3" in capsys.readouterr().err
    assert not out.exists()


def test_recovery_tells_what_it_saved_and_lost(tmp_path, capsys):
    broken, out = tmp_path / "broken.triquad", tmp_path / "out.triquad"
    squares = dataclasses.replace(SMALL, depth=9)
    record = random_record(5, settings=squares, indices=CUBE[:2], points=600)
    data = file_bytes(record, preview=True, stamp_ns=10**18)
    broken.write_bytes(data[:-100])
    assert main([str(broken), str(out)]) == 1
    assert "triquad-pack --recover" in capsys.readouterr().err
    assert not out.exists()
    assert main(["--recover", str(broken), str(out)]) == 0
    assert "saved all" in capsys.readouterr().out
    assert_same(read_map(out), record)
    broken.write_bytes(flipped(data, first_chunk(data, VERTICES).middle))
    assert main(["--recover", "--force", str(broken), str(out)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("lost: training state of region 0 0 0")
    assert lines[1] == (
        "lost: vertices of plane XY of region 0 0 0: now UNKNOWN, "
        "x -65.0 to 0.5 m, y -65.0 to 0.5 m, z -64.5 to 64.5 m"
    )
    assert lines[2].startswith("saved ")
    assert_same(read_map(out), recover(broken).record)
    before = out.read_bytes()
    broken.write_bytes(data[:100])
    assert main(["--recover", "--force", str(broken), str(out)]) == 2
    assert "nothing can be saved" in capsys.readouterr().err
    assert out.read_bytes() == before
