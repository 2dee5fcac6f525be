"""What the parts of a map file hold; every field is checked as it is read.

Sizes are checked before anything is decoded, which takes more memory than a part has bytes.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.parts.body import PartBody
from triquad_format.mapfile.parts.columns import (
    LEVEL_BITS,
    join_levels,
    unshuffle,
    unshuffle_counts,
)
from triquad_format.mapfile.parts.pack import SAMPLES_PER_PART
from triquad_format.mapfile.parts.part import (
    MOMENTS,
    SAMPLES,
    VERTICES,
    PartKey,
    cube_shift,
    square_shift,
)
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    BLOCK_BYTES,
    MAX_SEEN_S,
    MLP_LAYERS,
    Evidence,
    Mlp,
    surface_counts,
)

Columns = tuple[NDArray[Any], ...]
"""Columns of equal length: some rows of a table."""

COLUMN_TOPICS = (VERTICES, MOMENTS, SAMPLES)

_MAX_SEEN_BYTES = (MAX_SEEN_S.bit_length() + 7) // 8


@dataclass(frozen=True)
class RegionHead:
    """What a region has one of."""

    frequencies: NDArray[np.float32]
    mlp: Mlp
    scales: list[float]  # of each table, or none at all


@dataclass(frozen=True)
class TrainingHead:
    """What a region's training state has one of."""

    mlp_means: tuple[NDArray[np.float32], ...]
    mlp_variances: tuple[NDArray[np.float32], ...]
    mlp_steps: int
    budget_samples: int
    samples: int


def read_head(body: PartBody) -> RegionHead:
    """What a part ``/triquad/region`` holds.

    Raises:
        FormatError: a field is missing or malformed.
    """
    mlp = Mlp(body.arrays("weights", MLP_LAYERS), body.arrays("biases", MLP_LAYERS))
    scales = body.array("scales", "<f4", (None,)).tolist()
    return RegionHead(body.array("frequencies", "<f4", (None,)), mlp, scales)


def read_training_head(body: PartBody) -> TrainingHead:
    """What a part ``/triquad/training`` holds.

    Raises:
        FormatError: a field is missing or malformed.
    """
    return TrainingHead(
        mlp_means=body.arrays("mlp_means", 2 * MLP_LAYERS),
        mlp_variances=body.arrays("mlp_variances", 2 * MLP_LAYERS),
        mlp_steps=body.count("mlp_steps"),
        budget_samples=body.count("training_budget"),
        samples=body.count("samples"),
    )


def _read_vertices(body: PartBody, key: PartKey, settings: FieldSettings) -> tuple[Columns, ...]:
    size = settings.feature_size
    levels: list[Columns] = []
    for level, rows in zip(
        settings.levels, body.maps("levels", settings.feature_levels), strict=True
    ):
        shift = square_shift(settings, level)
        codes = _global(rows.codes("codes", 1 << shift), key, shift)
        if rows.has("integers"):
            levels.append((codes, rows.integers("integers", len(codes), size)))
        else:
            levels.append((codes, rows.floats("features", len(codes), size)))
    return tuple(levels)


def read_evidence(body: PartBody, key: PartKey) -> Evidence:
    """The evidence of a cube; its optional fields are ``None`` where the part has none.

    Raises:
        FormatError: a field is missing or malformed, or does not fit the others.
    """
    _check_place(body, key)
    codes = _global(body.codes("codes", 1 << cube_shift()), key, cube_shift())
    surface, free = (
        body.array(name, "|u1", (len(codes), BLOCK_BYTES)) for name in ("surface", "free")
    )
    return Evidence(
        codes,
        surface,
        free,
        levels=_read_levels(body, surface) if body.has("levels") else None,
        seen_s=_read_seen(body, surface) if body.has("seen_s") else None,
    )


def _read_levels(body: PartBody, surface: NDArray[np.uint8]) -> NDArray[np.uint8]:
    count = int(surface_counts(surface).sum())
    return join_levels(body.array("levels", "|u1", (LEVEL_BITS, (count + 7) // 8)), count)


def _read_seen(body: PartBody, surface: NDArray[np.uint8]) -> NDArray[np.int64]:
    touched = surface.any(axis=1)
    planes = body.array("seen_s", "|u1", (None, int(touched.sum())))
    if not 1 <= len(planes) <= _MAX_SEEN_BYTES:
        raise DamagedMapFileError(f"{body.topic}: seen_s has {len(planes)} bytes per time")
    start = body.count("seen_from_s")
    if start > MAX_SEEN_S:
        raise DamagedMapFileError(f"{body.topic}: seen_from_s = {start} is above {MAX_SEEN_S}")
    since = unshuffle_counts(planes)
    seen_s = np.zeros(len(surface), np.int64)
    seen_s[touched] = np.where(since > 0, start + since, 0)
    return seen_s


def _read_moments(body: PartBody, _key: PartKey, settings: FieldSettings) -> tuple[Columns, ...]:
    size = settings.feature_size
    levels: list[Columns] = []
    for level, rows in zip(
        settings.levels, body.maps("levels", settings.feature_levels), strict=True
    ):
        steps = rows.array("steps", "|u1", (4, None))
        count = steps.shape[1]
        rows.limit("steps", count, 1 << square_shift(settings, level))
        means, variances = (rows.floats(name, count, size) for name in ("means", "variances"))
        levels.append((means, variances, unshuffle(steps, "<i4")))
    return tuple(levels)


def _read_samples(body: PartBody, _key: PartKey, _settings: FieldSettings) -> tuple[Columns, ...]:
    points = body.array("points", "|u1", (4, None, 3))
    count = points.shape[1]
    body.limit("points", count, SAMPLES_PER_PART)
    return ((unshuffle(points, "<f4"), body.floats("labels", count)),)


_READERS: Mapping[str, Callable[[PartBody, PartKey, FieldSettings], tuple[Columns, ...]]] = {
    VERTICES: _read_vertices,
    MOMENTS: _read_moments,
    SAMPLES: _read_samples,
}


def read_columns(body: PartBody, key: PartKey, settings: FieldSettings) -> tuple[Columns, ...]:
    """The rows in a part of one of ``COLUMN_TOPICS``: those of each level; of samples, just one.

    Of vertices codes [V] and features [V, feature_size]; of moments means, variances and steps;
    of samples points [N, 3] and labels [N].

    Raises:
        FormatError: a field is missing or malformed, or does not fit the others.
    """
    _check_place(body, key)
    return _READERS[key.topic](body, key, settings)


def _check_place(body: PartBody, key: PartKey) -> None:
    body.expect("plane", key.plane)
    body.expect("cell", key.cell)


def _global(local: NDArray[np.int64], key: PartKey, shift: int) -> NDArray[np.int64]:
    """Codes [V] from those within a square or cube."""
    if len(local) and not 0 <= local.max() < 1 << shift:
        raise DamagedMapFileError(f"{key.topic}: a code lies outside of cell {key.cell}")
    if key.cell >= 1 << 60 - shift:
        raise DamagedMapFileError(f"{key.topic}: cell {key.cell} is out of range")
    return local + (key.cell << shift)
