import dataclasses
import io
import itertools
import math

import numpy as np
import pytest
from mcap.reader import make_reader
from support.checkpoint_folder import FIRST, HOUR_NS, START_NS, map_at, write_checkpoints
from support.map_records import SMALL, assert_same, random_record, with_progress, with_rays
from support.mapfile_edit import file_bytes, rewritten
from triquad_format.errors import FormatError
from triquad_format.mapfile.parts.part import REGION, PartKey
from triquad_format.mapfile.reader import read_map, read_map_file
from triquad_format.mapfile.writer import write_map
from triquad_format.records.crop import SLACK_LEAVES, crop_record, without_training
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.map_progress import MapProgress
from triquad_map.reference.evaluator import MapEvaluator
from triquad_tools.commands.pack import main

CUBE = tuple(itertools.product((0, 1), repeat=3))


@pytest.fixture
def map_file(tmp_path):
    path = tmp_path / "in.triquad"
    path.write_bytes(file_bytes(random_record(1, indices=CUBE, points=200), preview=True))
    return path


def box_points(low, high, count=2000):
    """Points in a box, many of them on its faces, edges and on leaf borders."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    points = np.random.default_rng(0).uniform(low, high, (count, 3))
    share = np.random.default_rng(1).integers(0, 4, (count, 3))
    points = np.where(share == 0, low, np.where(share == 1, high, points))
    snapped = np.clip(np.round(points[: count // 4] * 8) / 8, low, high)
    return np.concatenate([points, snapped])


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([-1, -1, -1], [1, 1, 1]),
        ([4.25, 4.5, 4.75], [8.0, 8.0, 8.0]),
        ([-100, 2, 2], [100, 2.1, 2.1]),
        ([6.0001, 6, 6], [6.0002, 7, 7]),
        ([-100, -100, -100], [100, 100, 100]),
    ],
)
def test_crop_answers_in_the_box_as_before(low, high):
    record = random_record(2, indices=CUBE, points=200)
    cropped = crop_record(record, low, high)
    points = box_points(low, high)
    before = MapEvaluator(record).query(points, gradient=True)
    after = MapEvaluator(cropped).query(points, gradient=True)
    np.testing.assert_array_equal(before.sdf, after.sdf)
    np.testing.assert_array_equal(before.status, after.status)
    np.testing.assert_array_equal(before.gradient, after.gradient)


def test_crop_at_default_settings():
    record = random_record(3, settings=FieldSettings(), points=2000)
    low, high = [-300.3, 100.1, -50], [-200.2, 380.4, 60]
    cropped = crop_record(record, low, high)
    points = box_points(low, high)
    before, after = (MapEvaluator(r).query(points, gradient=True) for r in (record, cropped))
    np.testing.assert_array_equal(before.sdf, after.sdf)
    np.testing.assert_array_equal(before.status, after.status)
    kept, all_ = (sum(len(t.codes) for t in r.regions[0].tables) for r in (cropped, record))
    assert kept < all_ / 3
    assert len(cropped.regions[0].evidence.codes) < len(record.regions[0].evidence.codes) / 10


def test_crop_keeps_the_training_budget_of_the_samples_it_keeps():
    record = random_record(4, points=100)
    before = record.regions[0].training
    after = crop_record(record, [-100, -100, 0], [100, 100, 100]).regions[0].training
    kept = len(after.sample_points)
    assert 0 < kept < 100
    assert after.budget_samples == math.ceil(before.budget_samples * kept / 100)
    empty = crop_record(record, [7.9, 7.9, 7.9], [7.95, 7.95, 7.95]).regions[0].training
    assert len(empty.sample_points) == empty.budget_samples == 0
    everything = crop_record(record, [-100] * 3, [100] * 3).regions[0].training
    assert everything.budget_samples == before.budget_samples


def test_crop_keeps_the_rays_that_end_in_the_box():
    record = with_rays(random_record(4, points=100))
    before = record.regions[0].training
    low, high = [0.0] * 3, [3 * SMALL.leaf_m] * 3
    after = crop_record(record, low, high).regions[0].training
    ends, slack_m = before.rays.ends_m(SMALL), SLACK_LEAVES * SMALL.leaf_m
    inside = ((ends >= -slack_m) & (ends <= high[0] + slack_m)).all(axis=1)
    assert 0 < inside.sum() < 100
    np.testing.assert_array_equal(after.rays.ends, before.rays.ends[inside])
    np.testing.assert_array_equal(
        after.rays.origins[after.rays.origin_of],
        before.rays.origins[before.rays.origin_of[inside]],
    )
    assert len(after.rays.origins) == len(np.unique(before.rays.origin_of[inside]))
    kept = len(after.sample_points) + len(after.rays)
    assert after.budget_samples == math.ceil(before.budget_samples * kept / 300)


def test_crop_can_be_written_and_keeps_training_rows(tmp_path):
    record = random_record(4, indices=CUBE, points=100)
    cropped = crop_record(record, [-1, -1, -1], [1, 1, 1])
    write_map(cropped, tmp_path / "map.triquad")
    assert_same(read_map(tmp_path / "map.triquad"), cropped)
    table, old = cropped.regions[0].tables[3], record.regions[0].tables[3]
    rows = np.searchsorted(old.codes, table.codes)
    training, before = cropped.regions[0].training, record.regions[0].training
    np.testing.assert_array_equal(training.table_means[3], before.table_means[3][rows])
    np.testing.assert_array_equal(training.table_steps[3], before.table_steps[3][rows])
    assert 0 < len(training.sample_points) < len(before.sample_points)
    assert np.abs(training.sample_points).max() <= 1 + SMALL.leaf_m


def test_crop_drops_regions_that_the_box_does_not_meet():
    record = random_record(5, indices=CUBE)
    assert [r.index for r in crop_record(record, [0, 0, 0], [1, 1, 1]).regions] == [(0, 0, 0)]
    assert crop_record(record, [500, 0, 0], [501, 1, 1]).regions == ()
    everything = crop_record(record, [-1e9] * 3, [1e9] * 3)
    assert_same(everything, record)


@pytest.mark.parametrize(
    ("low", "high"), [([0, 0, 0], [1, 0, 1]), ([0, 0, 0], [1, np.nan, 1]), ([0] * 3, [np.inf] * 3)]
)
def test_bad_boxes(low, high):
    with pytest.raises(FormatError, match="box"):
        crop_record(random_record(), low, high)


def test_without_training():
    record = without_training(random_record(6))
    assert record.regions[0].training is None
    assert_same(record.regions[0].tables, random_record(6).regions[0].tables)


def test_tool_packs(map_file, tmp_path, capsys):
    out = tmp_path / "out.triquad"
    box = ["--crop", "-1", "-1", "-1", "2.5", "2", "2"]
    assert main([str(map_file), str(out), *box, "--no-training"]) == 0
    assert "bytes" in capsys.readouterr().out
    assert out.stat().st_size < map_file.stat().st_size / 2
    expected = crop_record(read_map(map_file), [-1, -1, -1], [2.5, 2, 2])
    assert_same(read_map(out), without_training(expected))


def test_a_packed_map_still_tells_what_it_was_made_of(tmp_path):
    record = with_progress(random_record(1), MapProgress(60, 116_000_000, 0.25))
    write_map(record, tmp_path / "in.triquad")
    out = tmp_path / "out.triquad"
    options = ["--crop", "-4", "-4", "-4", "4", "4", "4", "--no-training"]
    assert main([str(tmp_path / "in.triquad"), str(out), *options]) == 0
    assert read_map(out).progress == record.progress


def test_tool_changes_precision(tmp_path):
    record = random_record(7, feature_dtype="<f4")
    fine, coarse = tmp_path / "fine.triquad", tmp_path / "coarse.triquad"
    fine.write_bytes(file_bytes(record, preview=True, feature_dtype="<f4"))
    assert main([str(fine), str(coarse), "--precision", "fp16"]) == 0
    assert read_map(coarse).regions[0].tables[0].features.dtype == np.float16
    again = tmp_path / "again.triquad"
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
    refused(2, "box", map_file, out, "--force", "--crop", *["1", "0", "0", "0", "1", "1"])
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
    data = bytearray(source.read_bytes())
    data[far.chunk_start_offset + far.chunk_length // 2] ^= 1
    source.write_bytes(data)
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
    newer = rewritten(map_file.read_bytes(), metadata={"min_reader_version": "2"})
    map_file.write_bytes(newer)
    assert main([str(map_file), str(out)]) == 2
    assert "map file version 2" in capsys.readouterr().err
    assert not out.exists()


def test_records_are_left_alone():
    record = random_record(8)
    copy = dataclasses.replace(record)
    crop_record(record, [0, 0, 0], [1, 1, 1])
    assert_same(record, copy)
    assert_same(record, random_record(8))
