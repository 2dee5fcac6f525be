"""Integer features: files shrink, and distances move by no more than was allowed."""

import dataclasses

import numpy as np
import pytest
from support.files.mapfile_edit import file_bytes, read_bytes
from support.maps.map_records import assert_same, random_record
from support.maps.small_world import settings, settled_mapper, world
from triquad_format.errors import FormatError
from triquad_format.mapfile.reader import read_map
from triquad_map.composition.composed_view import RecordedView
from triquad_tools.commands.pack import main
from triquad_tools.mapfiles.crop import crop_record
from triquad_tools.mapfiles.quantise import field_change, probes, quantise

OTHER_SEED = 77
FINE_M, COARSE_M = 0.0015, 0.005


@pytest.fixture(scope="module")
def street():
    """A piece of a trained map, as its file has it."""
    record = settled_mapper(settings(samples_per_ray=9.0), world(2)).publish().record()
    return read_bytes(file_bytes(crop_record(record, [0, -8, -3], [16, 8, 5])))


@pytest.fixture(scope="module")
def fine(street):
    return quantise(street, FINE_M)


@pytest.fixture(scope="module")
def coarse(street):
    return quantise(street, COARSE_M)


def test_random_maps_keep_to_the_limit():
    record = random_record(2, indices=((0, 0, 0), (1, 0, 0)), points=60)
    packed = quantise(record, 0.01)
    assert field_change(record, packed.record, OTHER_SEED).quantile_m <= 0.01
    assert packed.change.quantile_m <= 0.01
    for region in packed.record.regions:
        assert region.training is None
        assert all(table.features.dtype == np.int16 for table in region.tables)


@pytest.mark.parametrize(("name", "limit_m"), [("fine", FINE_M), ("coarse", COARSE_M)])
def test_a_trained_map_keeps_to_the_limit_and_shrinks(street, name, limit_m, request):
    packed = request.getfixturevalue(name)
    fresh = field_change(street, packed.record, OTHER_SEED)
    # Of other points than those that it was chosen by; and it does not waste what it may have.
    assert 0.5 * limit_m < fresh.quantile_m <= 1.1 * limit_m
    assert packed.change.largest_m < 4 * limit_m
    assert len(file_bytes(packed.record)) < 0.7 * len(file_bytes(street))


def test_statuses_stay(street, coarse):
    points = probes(street, 5)[::10]
    before, after = (RecordedView(record).query(points) for record in (street, coarse.record))
    np.testing.assert_array_equal(before.status, after.status)


def test_the_error_is_from_the_map_that_was_packed(street, fine):
    again = quantise(fine.record, 0.004)
    assert field_change(fine.record, again.record, OTHER_SEED).quantile_m <= 0.004
    assert field_change(street, again.record, OTHER_SEED).quantile_m <= 0.005


def test_a_map_without_evidence():
    nothing_seen = crop_record(random_record(1), [7.9, 7.9, 7.9], [7.95, 7.95, 7.95])
    assert quantise(nothing_seen, 0.001).change.largest_m == 0
    assert quantise(dataclasses.replace(nothing_seen, regions=()), 0.001).record.regions == ()


def test_a_limit_that_integers_cannot_keep(street):
    with pytest.raises(FormatError, match="allow a larger error"):
        quantise(street, 1e-9)


def test_tool(street, coarse, tmp_path, capsys):
    source, out = tmp_path / "in.triquad", tmp_path / "out.triquad"
    source.write_bytes(file_bytes(street, preview=True))
    assert main([str(source), str(out), "--max-error", "0.005"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "99 % of distances near surface moved by less than" in lines[1]
    assert "training state" in lines[2]
    assert_same(read_map(out), coarse.record)
    assert out.stat().st_size < 0.7 * source.stat().st_size
    # Integers stay what they are.
    copy = tmp_path / "copy.triquad"
    assert main([str(out), str(copy)]) == 0
    assert_same(read_map(copy), read_map(out))
    capsys.readouterr()
    assert main([str(out), str(copy), "--max-error", "0.005", "--force"]) == 0
    assert "both errors add up" in capsys.readouterr().err


@pytest.mark.parametrize("length", ["2", "-0.002", "nan", "0", "2mm"])
def test_lengths_that_are_none(tmp_path, capsys, length):
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path / "in"), str(tmp_path / "out.triquad"), f"--max-error={length}"])
    assert "is not a number in range: use 1e-05 to 0.1" in capsys.readouterr().err
