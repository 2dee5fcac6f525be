"""A region from its parts; every field is checked as it is read.

Sizes are checked before anything is decoded, which takes more memory than a part has bytes.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.parts.body import PartBody, unpack_body
from triquad_format.mapfile.parts.pack import RAYS_PER_PART, SAMPLES_PER_PART
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    LEVEL_BITS,
    MOMENTS,
    RAYS,
    REGION,
    SAMPLE_COLUMNS,
    SAMPLES,
    TRAINING,
    VERTICES,
    Column,
    PartKey,
    cube_shift,
    feature_column,
    join_bits,
    join_codes,
    leaf_shift,
    moment_columns,
    square_shift,
)
from triquad_format.records import morton
from triquad_format.records.arrays import Bytes, Longs
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import (
    AXES,
    BLOCK_BYTES,
    MARGIN_BITS,
    MLP_LAYERS,
    OUTCOME_BITS,
    Evidence,
    Mlp,
    Region,
    TrainingState,
    VertexTable,
    no_evidence,
    surface_counts,
)
from triquad_format.records.replay_rays import STEPS, ReplayRays, no_rays

_Columns = tuple[NDArray[Any], ...]
"""Columns of equal length: some rows of a table."""


class RegionParts:
    """The parts of one region, gathered in any order."""

    def __init__(self, index: RegionIndex, settings: FieldSettings) -> None:
        self._index = index
        self._settings = settings
        self._heads: dict[str, PartBody] = {}  # by topic, REGION and TRAINING
        self._cubes: dict[int, Evidence] = {}
        self._rows: dict[PartKey, tuple[_Columns, ...]] = {}  # of each level; of samples, just one

    def add(self, key: PartKey, payload: bytes) -> None:
        """Read a part.

        Raises:
            FormatError: it is malformed, or not the part that ``key`` says.
        """
        body = unpack_body(key.topic, payload)
        if body.index() != key.region:
            raise DamagedMapFileError(f"{key.topic}: of region {body.index()}, not {key.region}")
        if key.topic in (REGION, TRAINING):
            self._heads[key.topic] = body
            return
        body.expect("plane", key.plane)
        body.expect("cell", key.cell)
        if key.topic == EVIDENCE:
            self._cubes[key.cell] = _read_evidence(body, key)
        elif key.topic == SAMPLES:
            self._rows[key] = (body.columns(SAMPLE_COLUMNS, SAMPLES_PER_PART),)
        elif key.topic == RAYS:
            self._rows[key] = (_read_rays(body, key),)
        elif key.topic in (VERTICES, MOMENTS):
            self._rows[key] = self._read_levels(body, key)

    def region(self) -> Region:
        """Return the region; the caller has checked by the manifest that all parts are there.

        Raises:
            FormatError: a field of a head is missing or malformed, or parts do not fit together.
        """
        head = self._heads.get(REGION)
        if head is None:
            raise DamagedMapFileError(f"the part {REGION} of region {self._index} is missing")
        return Region(
            index=self._index,
            frequencies=head.array("frequencies", "<f4", (None,)),
            mlp=Mlp(head.arrays("weights", MLP_LAYERS), head.arrays("biases", MLP_LAYERS)),
            tables=self._tables(head.array("scales", "<f4", (None,)).tolist()),
            evidence=_joined_evidence([self._cubes[cell] for cell in sorted(self._cubes)]),
            training=self._training(),
        )

    def _read_levels(self, body: PartBody, key: PartKey) -> tuple[_Columns, ...]:
        """Return the rows of each level in a square of vertices, or of their moments."""
        settings = self._settings
        levels = []
        for level, rows in zip(
            settings.levels, body.maps("levels", settings.feature_levels), strict=True
        ):
            shift = square_shift(settings, level)
            if key.topic == MOMENTS:
                levels.append(rows.columns(moment_columns(settings), 1 << shift))
                continue
            codes = _read_codes(rows, key, shift)
            if rows.has("integers"):
                features = rows.integers("integers", len(codes), settings.feature_size)
            else:
                features = rows.column(feature_column(settings), len(codes))
            levels.append((codes, features))
        return tuple(levels)

    def _tables(self, scales: Sequence[float]) -> tuple[VertexTable, ...]:
        """Return the vertex tables, with their scales where there are any."""
        places = [(plane, level) for plane in range(len(AXES)) for level in self._settings.levels]
        if len(scales) not in (0, len(places)):
            raise DamagedMapFileError(f"{REGION}: {len(scales)} scales for {len(places)} tables")
        no_features = _no_rows([feature_column(self._settings)])
        rows = self._levels(VERTICES, (np.zeros(0, np.int64), *no_features))
        tables = []
        for number, ((plane, level), (codes, features)) in enumerate(
            zip(places, rows, strict=True)
        ):
            scale = scales[number] if scales else None
            if scale is not None and not len(codes):
                features = features.astype(np.int16)  # no part says of what dtype no rows are
            tables.append(VertexTable(plane, level, codes, features=features, scale=scale))
        return tuple(tables)

    def _levels(self, topic: str, empty: _Columns) -> list[_Columns]:
        """Return the rows of each plane's levels, those of all squares together."""
        planes = [self._of(topic, plane) for plane in range(len(AXES))]
        return [
            _joined(topic, [square[level] for square in squares], empty)
            for squares in planes
            for level in range(self._settings.feature_levels)
        ]

    def _of(self, topic: str, plane: int = 0) -> list[tuple[_Columns, ...]]:
        """Return the rows in the parts of a topic, in the order of their cells."""
        keys = sorted(key for key in self._rows if key.topic == topic and key.plane == plane)
        return [self._rows[key] for key in keys]

    def _training(self) -> TrainingState | None:
        head = self._heads.get(TRAINING)
        if head is None:
            return None
        moments = self._levels(MOMENTS, _no_rows(moment_columns(self._settings)))
        means, variances, steps = zip(*moments, strict=True)
        samples = [portion for (portion,) in self._of(SAMPLES)]
        points, labels = _joined(SAMPLES, samples, _no_rows(SAMPLE_COLUMNS))
        if len(points) != head.count("samples"):
            raise DamagedMapFileError(
                f"{SAMPLES}: {len(points)} samples, not {head.count('samples')}"
            )
        return TrainingState(
            table_means=means,
            table_variances=variances,
            table_steps=steps,
            mlp_means=head.arrays("mlp_means", 2 * MLP_LAYERS),
            mlp_variances=head.arrays("mlp_variances", 2 * MLP_LAYERS),
            mlp_steps=head.count("mlp_steps"),
            sample_points=points,
            sample_labels=labels,
            budget_samples=head.count("training_budget"),
            rays=self._rays(head),
        )

    def _rays(self, head: PartBody) -> ReplayRays:
        """Return the rays of all cubes, in the order of their leaves."""
        count = head.count("rays")
        keys = [key for key in self._rows if key.topic == RAYS]
        keys.sort(key=lambda key: (key.cell, key.plane))
        none = no_rays()
        empty = (none.ends, none.origin_of, none.slopes)
        ends, origin_of, slopes = _joined(RAYS, [self._rows[key][0] for key in keys], empty)
        if len(ends) != count:
            raise DamagedMapFileError(f"{RAYS}: {len(ends)} rays, not {count}")
        return ReplayRays(ends, origin_of, slopes, origins=head.array("origins", "<f4", (None, 3)))


def _read_codes(body: PartBody, key: PartKey, shift: int, most: int | None = None) -> Longs:
    """Return codes [V] within the region of those within a square or cube, ``most`` at most."""
    codes = body.codes("codes", most or 1 << shift)
    if len(codes) and not 0 <= codes.max() < 1 << shift:
        raise DamagedMapFileError(f"{key.topic}: a code lies outside of cell {key.cell}")
    if key.cell >= 1 << 60 - shift:
        raise DamagedMapFileError(f"{key.topic}: cell {key.cell} is out of range")
    return codes + (key.cell << shift)


def _read_rays(body: PartBody, key: PartKey) -> _Columns:
    """Return ends, numbers of origins and slopes of the rays that end in a cube."""
    leaves = _read_codes(body, key, leaf_shift(), most=RAYS_PER_PART)
    counts = body.counts("counts", len(leaves), RAYS_PER_PART)
    count = int(counts.sum())
    if count > RAYS_PER_PART or (counts < 1).any():
        raise DamagedMapFileError(f"{RAYS}: counts of {count} rays are out of range")
    inside = body.array("inside", "|u1", (3, count))
    if inside.max(initial=0) >= STEPS:
        raise DamagedMapFileError(f"{RAYS}: an end lies outside its leaf")
    corners = STEPS * morton.decode(leaves, 3)
    ends = corners.repeat(counts, axis=0) + inside.T
    origin_of = body.counts("origins", count, RAYS_PER_PART)
    if max(ends.max(initial=0), origin_of.max(initial=0)) >= 2**31:
        raise DamagedMapFileError(f"{RAYS}: a ray of cell {key.cell} is out of range")
    slopes = body.array("slopes", "|u1", (count,))
    return ends.astype(np.int32), origin_of.astype(np.int32), slopes


def _read_evidence(body: PartBody, key: PartKey) -> Evidence:
    """Return the evidence of a cube."""
    codes = _read_codes(body, key, cube_shift())
    surface, free = (
        body.array(name, "|u1", (len(codes), BLOCK_BYTES)) for name in ("surface", "free")
    )
    count = int(surface_counts(surface).sum())
    return Evidence(
        codes,
        surface,
        free,
        levels=join_bits(_planes(body, "levels", LEVEL_BITS, count), count),
        seen_s=_read_seen(body, surface),
        outcomes=_read_codes_of_voxels(body, "outcomes", OUTCOME_BITS, count),
        margins=_read_codes_of_voxels(body, "margins", MARGIN_BITS, count),
    )


def _read_codes_of_voxels(body: PartBody, key: str, widths: Sequence[int], count: int) -> Bytes:
    """Return codes [count, C] of surface voxels, one column for each of ``widths``, in bits."""
    return join_codes(_planes(body, key, sum(widths), count), widths, count)


def _planes(body: PartBody, key: str, planes: int, count: int) -> Bytes:
    """Return ``planes`` planes of bits of ``count`` surface voxels."""
    return body.array(key, "|u1", (planes, (count + 7) // 8))


def _read_seen(body: PartBody, surface: Bytes) -> Longs:
    """Return the times [B] of blocks with these masks; a sum that overflows is negative."""
    touched = surface.any(axis=1)
    count = int(touched.sum())
    since = body.counts("seen_s", count, count)
    seen_s = np.zeros(len(surface), np.int64)
    seen_s[touched] = np.where(since > 0, body.count("seen_from_s") + since, 0)
    return seen_s


def _no_rows(columns: Sequence[Column]) -> _Columns:
    """Return these columns without rows."""
    return tuple(np.zeros((0, *column.row), column.dtypes[0]) for column in columns)


def _joined(topic: str, portions: Sequence[_Columns], empty: _Columns) -> _Columns:
    """Return the rows of all portions, column by column."""
    # A portion without rows gives dtypes where there is no other.
    kept = [portion for portion in portions if len(portion[0])] or [*portions[:1], empty][:1]
    kinds = [(column.dtype, column.shape[1:]) for column in kept[0]]
    for portion in kept[1:]:
        if [(column.dtype, column.shape[1:]) for column in portion] != kinds:
            raise DamagedMapFileError(f"{topic}: parts of a table differ in dtype or shape")
    if len(kept) == 1:
        return kept[0]
    return tuple(np.concatenate(column) for column in zip(*kept, strict=True))


def _joined_evidence(portions: Sequence[Evidence]) -> Evidence:
    """Return the evidence of a region from that of its cubes, in their order."""
    if len(portions) == 1:
        return portions[0]
    whole = [no_evidence(), *portions]
    names = [field.name for field in dataclasses.fields(Evidence)]
    columns = {name: np.concatenate([getattr(one, name) for one in whole]) for name in names}
    return Evidence(**columns)
