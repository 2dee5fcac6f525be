"""Small random map records, valid in every field, for any test that needs a map."""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings, RegionIndex
from triquad_format.records.region import (
    AXES,
    BLOCK_BYTES,
    MARGIN_BITS,
    MAX_LEVEL,
    OUTCOME_BITS,
    Evidence,
    MapRecord,
    Mlp,
    Region,
    TrainingState,
    VertexTable,
)
from triquad_format.records.replay_rays import STEPS, ReplayRays

SMALL = FieldSettings(
    leaf_m=0.25, depth=6, feature_levels=2, feature_size=3, frequencies=4, hidden=5,
    frequency_variance=4.0, logit_scale_m=0.5,
)  # fmt: skip
"""A region of 16 m that overlaps its neighbours by 4 m."""


def random_record(
    seed: int = 0,
    *,
    settings: FieldSettings = SMALL,
    indices: tuple[RegionIndex, ...] = ((0, 0, 0),),
    points: int = 40,
    training: bool = True,
    feature_dtype: str = "<f2",
    name: str = "default",
    epoch: int = 7,
) -> MapRecord:
    """A record whose regions have seen ``points`` random surface points each."""
    rng = np.random.RandomState(seed)  # its numbers never change, whatever numpy's release
    regions = tuple(
        random_region(rng, settings, index, points, training, feature_dtype) for index in indices
    )
    return MapRecord(name, epoch, settings, regions)


def random_region(
    rng: np.random.RandomState,
    settings: FieldSettings,
    index: RegionIndex,
    points: int,
    training: bool,
    feature_dtype: str,
) -> Region:
    """A region with vertices and evidence at random leaves."""
    leaves = rng.randint(0, 1 << settings.depth, (points, 3), np.int64)
    tables = tuple(
        _table(rng, settings, leaves, plane, level, feature_dtype)
        for plane in range(len(AXES))
        for level in settings.levels
    )
    mlp = _mlp(rng, settings)
    return Region(
        index=index,
        frequencies=_floats(rng, settings.frequencies)
        * np.float32(math.sqrt(settings.frequency_variance)),
        mlp=mlp,
        tables=tables,
        evidence=_evidence(rng, leaves),
        training=_training(rng, mlp, tables, points) if training else None,
    )


def _floats(rng: np.random.RandomState, *shape: int) -> NDArray[np.float32]:
    """Uniform in [-2, 2), of so few bits that every machine makes the same."""
    return (rng.randint(-(2**15), 2**15, shape, np.int64) / 2**14).astype(np.float32)


def _table(
    rng: np.random.RandomState,
    settings: FieldSettings,
    leaves: NDArray[np.int64],
    plane: int,
    level: int,
    dtype: str,
) -> VertexTable:
    nodes = leaves[:, AXES[plane]] >> (settings.depth - level)
    corners = np.concatenate([nodes + (a, b) for a in (0, 1) for b in (0, 1)])
    codes = np.unique(morton.encode(corners))
    features = _floats(rng, len(codes), settings.feature_size).astype(dtype)
    return VertexTable(plane, level, codes, features)


def _mlp(rng: np.random.RandomState, settings: FieldSettings) -> Mlp:
    sizes = (settings.input_size, settings.hidden, settings.hidden, 1)
    pairs = list(zip(sizes[:-1], sizes[1:], strict=True))
    weights = tuple(_floats(rng, a, b) * np.float32(1 / math.sqrt(a)) for a, b in pairs)
    return Mlp(weights, tuple(_floats(rng, b) for _, b in pairs))


def _evidence(rng: np.random.RandomState, leaves: NDArray[np.int64]) -> Evidence:
    codes = blocks_of(leaves)
    surface = masks(codes, leaves)
    free = rng.randint(0, 256, surface.shape, np.int64).astype(np.uint8)
    return evidence_of(codes, surface, free)


def evidence_of(
    codes: NDArray[np.int64], surface: NDArray[np.uint8], free: NDArray[np.uint8]
) -> Evidence:
    """Evidence of which no more is known than where rays ended and passed."""
    voxels = int(np.unpackbits(surface).sum())
    return Evidence(
        codes,
        surface,
        free,
        levels=np.zeros(voxels, np.uint8),
        seen_s=np.zeros(len(codes), np.int64),
        outcomes=np.zeros((voxels, len(OUTCOME_BITS)), np.uint8),
        margins=np.zeros((voxels, len(MARGIN_BITS)), np.uint8),
    )


def surface_evidence(points: NDArray[np.float64], settings: FieldSettings) -> Evidence:
    """Evidence of surface at points [N, 3], metres from a region's centre."""
    leaves = np.floor(points / settings.leaf_m).astype(np.int64) + (1 << (settings.depth - 1))
    codes = blocks_of(leaves)
    surface = masks(codes, leaves)
    return evidence_of(codes, surface, np.zeros_like(surface))


def blocks_of(leaves: NDArray[np.int64]) -> NDArray[np.int64]:
    """Codes [B] of the blocks with leaves [N, 3]."""
    return np.unique(morton.encode(leaves // BLOCK_VOXELS))


def masks(codes: NDArray[np.int64], leaves: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Bits [B, BLOCK_BYTES] of the leaves [N, 3] in their blocks."""
    bits = np.zeros((len(codes), BLOCK_BYTES), np.uint8)
    rows = np.searchsorted(codes, morton.encode(leaves // BLOCK_VOXELS))
    x, y, z = (leaves % BLOCK_VOXELS).T
    np.bitwise_or.at(bits, (rows, x * BLOCK_VOXELS + y), (1 << z).astype(np.uint8))
    return bits


def _training(
    rng: np.random.RandomState, mlp: Mlp, tables: tuple[VertexTable, ...], samples: int
) -> TrainingState:
    arrays = (*mlp.weights, *mlp.biases)
    return TrainingState(
        table_means=tuple(_floats(rng, *table.features.shape) for table in tables),
        table_variances=tuple(_floats(rng, *table.features.shape) ** 2 for table in tables),
        table_steps=tuple(
            rng.randint(0, 1000, len(table.codes), np.int64).astype(np.int32) for table in tables
        ),
        mlp_means=tuple(_floats(rng, *array.shape) for array in arrays),
        mlp_variances=tuple(_floats(rng, *array.shape) ** 2 for array in arrays),
        mlp_steps=int(rng.randint(0, 10**6, dtype=np.int64)),
        sample_points=_floats(rng, samples, 3),
        sample_labels=_floats(rng, samples).astype(np.float16),
        budget_samples=int(rng.randint(0, 10**6, dtype=np.int64)),
    )


def with_region(record: MapRecord, **parts: Any) -> MapRecord:
    """The record whose first region has some other ``parts``."""
    first, *others = record.regions
    return dataclasses.replace(record, regions=(dataclasses.replace(first, **parts), *others))


def with_evidence(record: MapRecord, **parts: Any) -> MapRecord:
    """The record in whose first region something else is known."""
    evidence = dataclasses.replace(record.regions[0].evidence, **parts)
    return with_region(record, evidence=evidence)


def with_integers(record: MapRecord, limit: int = 100, seed: int = 0) -> MapRecord:
    """The record with integer features up to ``limit`` in place of its own."""
    rng = np.random.RandomState(seed)
    regions = tuple(
        dataclasses.replace(region, tables=tuple(_integers(rng, t, limit) for t in region.tables))
        for region in record.regions
    )
    return dataclasses.replace(record, regions=regions)


def _integers(rng: np.random.RandomState, table: VertexTable, limit: int) -> VertexTable:
    features = rng.randint(-limit, limit + 1, table.features.shape, np.int64).astype(np.int16)
    features[:1] = limit
    return dataclasses.replace(table, features=features, scale=2.0 ** -rng.randint(1, 9))


def with_support(record: MapRecord, seed: int = 0) -> MapRecord:
    """The record with levels, times, outcomes and margins of its surface, some not known."""
    rng = np.random.RandomState(seed)
    regions = tuple(
        dataclasses.replace(region, evidence=_supported(rng, region.evidence))
        for region in record.regions
    )
    return dataclasses.replace(record, regions=regions)


def _supported(rng: np.random.RandomState, evidence: Evidence) -> Evidence:
    counts = np.unpackbits(evidence.surface, axis=1).sum(axis=1)
    voxels = int(counts.sum())
    levels = rng.randint(0, MAX_LEVEL + 1, voxels, np.int64).astype(np.uint8)
    seen_s = 1_700_000_000 + rng.randint(0, 400, len(counts), np.int64)
    seen_s *= (counts > 0) & (rng.randint(0, 4, len(counts), np.int64) > 0)
    codes = [rng.randint(0, 1 << bits, voxels, np.int64) for bits in OUTCOME_BITS]
    outcomes = np.stack(codes, axis=1) * rng.randint(0, 2, (voxels, 1), np.int64)
    shape = (voxels, len(MARGIN_BITS))
    margins = rng.randint(1, 4, shape, np.int64) * (rng.randint(0, 3, shape, np.int64) == 0)
    return dataclasses.replace(
        evidence,
        levels=levels,
        seen_s=seen_s,
        outcomes=outcomes.astype(np.uint8),
        margins=margins.astype(np.uint8),
    )


def with_rays(record: MapRecord, rays: int = 200, seed: int = 0) -> MapRecord:
    """The record, which has training state, with rays to train on; some end outside the region."""
    rng = np.random.RandomState(seed)
    regions = []
    for region in record.regions:
        assert region.training is not None
        training = dataclasses.replace(region.training, rays=_rays(rng, record.settings, rays))
        regions.append(dataclasses.replace(region, training=training))
    return dataclasses.replace(record, regions=tuple(regions))


def _rays(rng: np.random.RandomState, settings: FieldSettings, count: int) -> ReplayRays:
    middle = STEPS << settings.depth
    ends = rng.randint(0, 2 * middle, (count, 3), np.int64)
    ends[: count // 2] = middle + rng.randint(0, 5 * STEPS, (count // 2, 3), np.int64)
    ends = ends[np.argsort(morton.encode(ends // STEPS), kind="stable")].astype(np.int32)
    origin_of = rng.randint(0, 300, count, np.int64).astype(np.int32)
    slopes = rng.randint(0, 256, count, np.int64).astype(np.uint8)
    return ReplayRays(ends, origin_of, slopes, origins=_floats(rng, 300, 3))


def assert_same(have: object, want: object, where: str = "record") -> None:
    """Fail, naming the field, unless two records are equal in every value and dtype."""
    if dataclasses.is_dataclass(want):
        assert type(have) is type(want), where
        for field in dataclasses.fields(want):
            name = f"{where}.{field.name}"
            assert_same(getattr(have, field.name), getattr(want, field.name), name)
    elif isinstance(want, np.ndarray):
        assert isinstance(have, np.ndarray), where
        assert have.dtype == want.dtype, where
        np.testing.assert_array_equal(have, want, err_msg=where)
    elif isinstance(want, tuple):
        assert isinstance(have, tuple), where
        assert len(have) == len(want), where
        for i, (one, other) in enumerate(zip(have, want, strict=True)):
            assert_same(one, other, f"{where}[{i}]")
    else:
        assert have == want, where
