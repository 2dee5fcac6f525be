"""docs/map-file.md is complete: a reader written from it alone answers as the project's does."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.files import golden, spec_reader
from support.files.checkpoint_folder import write_record
from support.files.mapfile_edit import rewritten
from support.files.spec_answers import Map
from support.files.spec_parts import RefusedError, Region, Settings, is_held_out
from support.maps import map_records
from support.maps.map_records import SMALL
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapRecord
from triquad_format.records.replay_rays import are_held_out
from triquad_map.composition.composed_view import RecordedView
from triquad_map.evidence.evidence import outcome_counts

NEIGHBOURS = ((0, 0, 0), (1, 0, 0), (0, -1, 0), (1, -1, 0), (0, 0, 1))
WIDE = dataclasses.replace(SMALL, depth=10)
"""Four squares to a side."""


def with_step(record: MapRecord, step: float) -> MapRecord:
    """The record with another scale of its integers, which is no power of two."""
    scale = float(np.float32(step))
    regions = []
    for region in record.regions:
        tables = tuple(dataclasses.replace(table, scale=scale) for table in region.tables)
        regions.append(dataclasses.replace(region, tables=tables))
    return dataclasses.replace(record, regions=tuple(regions))


VARIANTS = {
    "a training state": map_records.random_record(1, points=400),
    "overlapping regions": map_records.random_record(2, indices=NEIGHBOURS, points=200),
    "single-precision features": map_records.random_record(3, feature_dtype="<f4", points=400),
    "integers of a byte": map_records.with_integers(map_records.random_record(4, points=400)),
    "integers of two bytes": with_step(
        map_records.with_integers(map_records.random_record(5, points=400), limit=32_000), 1e-4
    ),
    "features alone": map_records.random_record(
        6,
        settings=dataclasses.replace(SMALL, encoding="features", feature_levels=4, leaf_m=0.2),
        points=400,
    ),
    "no features": map_records.random_record(
        7, settings=dataclasses.replace(SMALL, encoding="fourier", depth=7), points=1000
    ),
    "many squares": map_records.random_record(
        8, settings=WIDE, indices=((0, 0, 0), (0, 1, 0)), points=2000
    ),
    "support": map_records.with_support(
        map_records.random_record(12, settings=WIDE, indices=((0, 0, 0), (0, 1, 0)), points=1000)
    ),
    "no vertices": map_records.random_record(9, points=0),
    "settings as they are by default": map_records.random_record(
        13, settings=FieldSettings(), points=100, training=False
    ),
    "far from zero": dataclasses.replace(
        map_records.random_record(15, indices=NEIGHBOURS, points=200),
        origin_m=(450_000.0, 5_400_000.0, -0.3),
    ),
}


def probes(answers: Map, count: int = 4000) -> NDArray[np.float64]:
    """Points in, around and far outside a map's regions, borders of cells and voxels among them.

    Half of them lie near the rows of the evidence, where a status other than unknown is likely.
    """
    rng = np.random.default_rng(0)
    settings = answers.settings
    centres = np.array([region.centre for region in answers.regions.values()])
    anywhere = rng.uniform(-0.6, 0.6, (count, 3)) * settings.side + rng.choice(centres, count)
    on_borders = np.round(anywhere[::4] / (settings.leaf / 2)) * (settings.leaf / 2)
    voxels = np.concatenate([surface_voxels(region) for region in answers.regions.values()])
    if len(voxels):
        near = rng.choice(voxels, count) + rng.uniform(-2, 2, (count, 3)) * settings.leaf
        anywhere = np.concatenate([anywhere, near])
    return answers.origin + np.concatenate([anywhere, on_borders, centres + 100 * settings.side])


def surface_voxels(region: Region) -> NDArray[np.float64]:
    """Middles of the voxels whose surface bit is set."""
    table, settings = region.surface, region.settings
    bits = np.unpackbits(table.values[:-1].reshape(-1, 8, 8, 1), axis=-1, bitorder="little")
    row, *inner = np.nonzero(bits)
    blocks = np.stack([table.places[:-1] >> 20 * axis & (1 << 20) - 1 for axis in range(3)], -1)
    voxels = 8 * blocks[row] + np.stack(inner, -1)
    return (voxels + 0.5 - 2 ** (settings.depth - 1)) * settings.leaf + region.centre


def assert_agree(answers: Map, record: MapRecord, points: NDArray[np.float64]) -> None:
    (have_sdf, have_gradient), status = answers.distance(points), answers.status(points)
    points = points - record.origin  # which the view counts from
    want = RecordedView(record).query(points, gradient=True)
    np.testing.assert_array_equal(status, want.status)
    np.testing.assert_allclose(have_sdf, want.sdf, rtol=1e-5, atol=1e-5)
    assert np.isfinite(have_sdf).any()
    apart = ~np.isclose(have_gradient, want.gradient, rtol=1e-3, atol=1e-3, equal_nan=True)
    # On borders of cells, and in sums next to max(y, 0), rounding decides on the side.
    halves = 2 * points / record.settings.leaf_m
    within = (np.abs(halves - np.round(halves)) > 1e-3).all(axis=1)
    assert apart.any(1)[within].mean() < 1e-3


def assert_same_support(answers: Map, record: MapRecord) -> None:
    """What is known of surface is that of the record, voxel by voxel."""
    for region in record.regions:
        evidence, have = region.evidence, answers.regions[region.index]
        blocks = morton.decode(evidence.codes, 3)
        bits = np.unpackbits(evidence.surface, axis=1, bitorder="little").astype(bool)
        np.testing.assert_array_equal(have.seen(blocks)[:, 0], evidence.seen_s)
        outcomes = have.outcomes(blocks).reshape(*bits.shape, 3)
        margins = have.margins(blocks).reshape(*bits.shape, 6)
        counts = outcome_counts(evidence.outcomes)
        for column, wanted in (
            (have.levels(blocks), evidence.levels),
            (outcomes.astype(np.int64), counts),
            (margins, evidence.margins),
        ):
            assert not column[~bits].any()
            np.testing.assert_array_equal(column[bits], wanted)


def write_variant(path: Path, name: str) -> Path:
    dtype = "<f4" if name.startswith("single") else "<f2"
    write_map(VARIANTS[name], path, feature_dtype=dtype)
    return path


@pytest.mark.parametrize("name", [golden.TRAINED, golden.PLAIN])
def test_the_samples(name: str) -> None:
    answers = spec_reader.load(golden.FOLDER / name)
    points = probes(answers)
    assert {0, 2} <= set(answers.status(points))
    record = read_map(golden.FOLDER / name)
    assert_agree(answers, record, points)
    assert_same_support(answers, record)


def test_rays_to_train_on() -> None:
    path = golden.FOLDER / golden.TRAINED
    record = read_map(path)
    tables = []
    for region in record.regions:
        assert region.training is not None
        rays = region.training.rays
        ends, origins = rays.ends_m(record.settings), rays.origins[rays.origin_of]
        tables.append(np.column_stack([ends, origins, rays.slopes / 255]))
    want = np.concatenate(tables)
    have = spec_reader.load_rays(path, spec_reader.load(path).settings)
    order = [np.lexsort(table.round(6).T) for table in (have, want)]
    np.testing.assert_allclose(have[order[0]], want[order[1]], atol=1e-6)


def test_held_out_rays() -> None:
    """At the greatest depth, too, where steps are more than a key has room for."""
    for depth in (6, 15):
        settings = dataclasses.replace(SMALL, depth=depth)
        record = map_records.with_rays(
            map_records.random_record(2, settings=settings, points=0), rays=5000
        )
        (training,) = (region.training for region in record.regions)
        assert training is not None
        ends = training.rays.ends_m(settings)
        as_said = [is_held_out(end, Settings(dataclasses.asdict(settings))) for end in ends]
        assert are_held_out(training.rays.ends).tolist() == as_said
        assert sum(as_said) == pytest.approx(5000 / 32, rel=0.3)


@pytest.mark.parametrize("name", VARIANTS)
def test_maps_of_every_kind(tmp_path: Path, name: str) -> None:
    path = write_variant(tmp_path / "map.triquad", name)
    answers = spec_reader.load(path)
    points = probes(answers)
    if name != "no vertices":
        assert set(answers.status(points)) == {0, 1, 2}
    record = read_map(path)
    assert_agree(answers, record, points)
    assert_same_support(answers, record)


# Section 9


def test_one_place_is_read_by_the_index(tmp_path: Path) -> None:
    path = write_variant(tmp_path / "map.triquad", "many squares")
    record = read_map(path)
    points = probes(spec_reader.load(path), 8)
    assert np.isfinite(RecordedView(record).query(points).sdf).sum() > 8
    for point in points:
        file, parts = spec_reader.read_near(path, point[None])
        near = Map(file.values, parts)
        have, want = near.distance(point[None])[0], RecordedView(record).query(point[None])
        np.testing.assert_allclose(have, want.sdf, rtol=1e-5, atol=1e-5)
        assert near.status(point[None]) == want.status
        assert file.file.bytes_read < path.stat().st_size / 4


# Section 10


def test_a_checkpoint_is_read(tmp_path: Path) -> None:
    record = golden.golden_records()[golden.TRAINED]
    path = write_record(tmp_path, record)
    answers = spec_reader.load_checkpoint(path)
    assert_agree(answers, read_map(path), probes(answers))


# What must be refused


def test_digests_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "map.triquad"
    data = (golden.FOLDER / golden.TRAINED).read_bytes()
    for number in range(len(spec_reader.MapFile(golden.FOLDER / golden.TRAINED).rows)):
        path.write_bytes(rewritten(data, payloads={number: b"another"}, fitting=False))
        assert_refused(path)


def assert_refused(path: Path) -> None:
    """The reader of the page refuses the file; test_damage has the project's do so."""
    with pytest.raises((RefusedError, spec_reader.zstandard.ZstdError)):
        spec_reader.load(path)
