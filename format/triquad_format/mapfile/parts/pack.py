"""A map record as the parts of a map file, each a msgpack map, as ``docs/map-file.md`` says.

:mod:`triquad_format.mapfile.parts.region_parts` is the way back.
"""

import typing
from collections.abc import Callable, Iterator, Mapping, Sequence

import msgpack
import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import FormatError
from triquad_format.mapfile.container import compress
from triquad_format.mapfile.parts.part import (
    EVIDENCE,
    LEVEL_BITS,
    MAX_PART_BYTES,
    MOMENTS,
    RAYS,
    REGION,
    SAMPLE_COLUMNS,
    SAMPLES,
    TRAINING,
    VERTICES,
    Column,
    Part,
    PartKey,
    cube_shift,
    feature_column,
    leaf_shift,
    moment_columns,
    shuffle,
    shuffle_codes,
    shuffle_counts,
    split_bits,
    split_codes,
    split_integers,
    square_shift,
)
from triquad_format.records import morton
from triquad_format.records.arrays import Longs
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import (
    AXES,
    MARGIN_BITS,
    OUTCOME_BITS,
    MapRecord,
    Region,
    TrainingState,
    VertexTable,
    surface_counts,
)
from triquad_format.records.replay_rays import STEPS, ReplayRays
from triquad_format.wire.packing import pack_array

SAMPLES_PER_PART = 1 << 17
RAYS_PER_PART = 1 << 21


def pack_part(key: PartKey, body: Mapping[str, object]) -> Part:
    """Return a part of this body: numbers, strings, lists, maps and packed arrays."""
    return Part(key, typing.cast(bytes, msgpack.packb({"topic": key.topic, **body})))


def check_part(part: Part) -> None:
    """Raise :class:`FormatError` for a part that is too large to be read."""
    if len(part.payload) > MAX_PART_BYTES:
        raise FormatError(
            f"the part {part.key.topic} has {len(part.payload)} bytes; "
            f"a map file holds parts of at most {MAX_PART_BYTES}",
        )


def compressed(part: Part) -> bytes:
    """Return a part's payload as the zstd frame that files hold.

    Features and moments are noise but for their high bytes, on which level 1 is as good as level 19
    and better than level 3; masks and codes shrink by a fifth to level 12.
    """
    level = {EVIDENCE: 12, REGION: 3}.get(part.key.topic, 1)
    return compress(part.payload, level)


def pack_record(
    record: MapRecord, feature_dtype: str, previews: Mapping[RegionIndex, Part]
) -> Iterator[Part]:
    """Yield the parts of all regions of a checked record, each region's preview after them.

    Raises:
        FormatError: features do not fit ``feature_dtype``, one of ``FLOATS``.
    """
    for region in record.regions:
        yield from pack_region(region, record.settings, feature_dtype)
        if region.index in previews:
            yield previews[region.index]


def pack_region(region: Region, settings: FieldSettings, feature_dtype: str) -> Iterator[Part]:
    """Yield the parts of a checked region, in the order of the file: place by place.

    What is left of a file that was cut off is then a map of a part of the world.
    ``feature_dtype``, one of ``FLOATS``, is for features that are not integers.

    Raises:
        FormatError: features do not fit ``feature_dtype``; the text names the region.
    """
    yield _pack_head(region)
    vertices = {part.key: part for part in _pack_vertices(region, settings, feature_dtype)}
    for evidence in _pack_evidence(region):
        for key in _squares_of(evidence.key):
            if key in vertices:
                yield vertices.pop(key)
        yield evidence
    yield from vertices.values()
    if region.training is not None:
        yield from _pack_training(region, region.training, settings)


def _squares_of(cube: PartKey) -> Iterator[PartKey]:
    """Yield the keys of the vertices that the evidence in a cube needs, but for its border."""
    corner = morton.decode(np.array([cube.cell]), 3)
    for plane, axes in enumerate(AXES):
        (square,) = morton.encode(corner[:, list(axes)])
        yield PartKey(VERTICES, cube.region, plane, int(square))


def _region_part(key: PartKey, fields: Mapping[str, object]) -> Part:
    """Return a part of a region, with what gives its place."""
    place: dict[str, object] = {"region": list(key.region)}
    if key.topic not in (REGION, TRAINING):
        place |= {"plane": key.plane, "cell": key.cell}
    return pack_part(key, {**place, **fields})


def _pack_columns(
    columns: Sequence[Column], values: Sequence[NDArray[np.generic]]
) -> dict[str, object]:
    return {
        column.name: pack_array(shuffle(array))
        for column, array in zip(columns, values, strict=True)
    }


def _pack_head(region: Region) -> Part:
    scales = [table.scale for table in region.tables]
    body = {
        "frequencies": pack_array(region.frequencies),
        "weights": [pack_array(weight) for weight in region.mlp.weights],
        "biases": [pack_array(bias) for bias in region.mlp.biases],
        "scales": pack_array(np.array([s for s in scales if s is not None], np.float32)),
    }
    return _region_part(PartKey(REGION, region.index), body)


def _pack_squares(
    topic: str,
    region: Region,
    settings: FieldSettings,
    *,
    fields_of: Callable[[int, slice], Mapping[str, object]],
) -> Iterator[Part]:
    """Yield a part for each square that contains vertices.

    ``fields_of`` gives what a part contains of some rows of a table, which it gets by its number.
    """
    for plane in range(len(AXES)):
        cells = {
            number: table.codes >> square_shift(settings, table.level)
            for number, table in enumerate(region.tables)
            if table.plane == plane
        }
        for cell in np.unique(np.concatenate(list(cells.values()))).tolist():
            levels = [fields_of(number, _rows_of(of, cell)) for number, of in cells.items()]
            key = PartKey(topic, region.index, plane=plane, cell=cell)
            yield _region_part(key, {"levels": levels})


def _rows_of(cells: Longs, cell: int) -> slice:
    first, last = np.searchsorted(cells, [cell, cell + 1])
    return slice(int(first), int(last))


def _pack_vertices(region: Region, settings: FieldSettings, dtype: str) -> Iterator[Part]:
    def fields_of(number: int, rows: slice) -> Mapping[str, object]:
        table = region.tables[number]
        within = (1 << square_shift(settings, table.level)) - 1
        codes = pack_array(shuffle_codes(table.codes[rows] & within))
        try:
            return {"codes": codes, **_pack_features(table, rows, settings, dtype=dtype)}
        except FormatError as error:
            raise FormatError(f"region {region.index}: {error}") from error

    return _pack_squares(VERTICES, region, settings, fields_of=fields_of)


def _pack_features(
    table: VertexTable, rows: slice, settings: FieldSettings, *, dtype: str
) -> dict[str, object]:
    features = table.features[rows]
    if table.scale is not None:
        return {"integers": pack_array(split_integers(features.astype(np.int16)))}
    with np.errstate(over="ignore"):
        features = features.astype(dtype)
    if not np.isfinite(features).all():
        raise FormatError(
            f"features of plane {table.plane}, level {table.level} reach "
            f"{np.abs(table.features).max()}, which {dtype} does not hold; use '<f4'",
        )
    return _pack_columns([feature_column(settings)], [features])


def _pack_evidence(region: Region) -> Iterator[Part]:
    evidence = region.evidence
    cells = evidence.codes >> cube_shift()
    first_voxel = np.concatenate([[0], np.cumsum(surface_counts(evidence.surface))])
    for cell in np.unique(cells).tolist():
        rows = _rows_of(cells, cell)
        surface = evidence.surface[rows]
        fields: dict[str, object] = {
            "codes": pack_array(shuffle_codes(evidence.codes[rows] - (cell << cube_shift()))),
            "surface": pack_array(surface),
            "free": pack_array(evidence.free[rows]),
        }
        voxels = slice(first_voxel[rows.start], first_voxel[rows.stop])
        outcomes, margins = evidence.outcomes[voxels], evidence.margins[voxels]
        fields |= {
            "levels": pack_array(split_bits(evidence.levels[voxels], LEVEL_BITS)),
            **_seen_fields(evidence.seen_s[rows][surface.any(axis=1)]),
            "outcomes": pack_array(split_codes(outcomes, OUTCOME_BITS)),
            "margins": pack_array(split_codes(margins, MARGIN_BITS)),
        }
        yield _region_part(PartKey(EVIDENCE, region.index, cell=cell), fields)


def _seen_fields(seen_s: Longs) -> dict[str, object]:
    """Return times of the blocks with surface, in seconds since shortly before the first."""
    known = seen_s[seen_s > 0]
    start = int(known.min()) - 1 if len(known) else 0
    since = np.maximum(seen_s - start, 0)
    return {"seen_from_s": start, "seen_s": pack_array(shuffle_counts(since))}


def _pack_training(
    region: Region, training: TrainingState, settings: FieldSettings
) -> Iterator[Part]:
    fields = {
        "mlp_means": [pack_array(mean) for mean in training.mlp_means],
        "mlp_variances": [pack_array(variance) for variance in training.mlp_variances],
        "mlp_steps": training.mlp_steps,
        "training_budget": training.budget_samples,
        "samples": len(training.sample_points),
        "rays": len(training.rays),
        "origins": pack_array(training.rays.origins),
    }
    yield _region_part(PartKey(TRAINING, region.index), fields)
    moments = (training.table_means, training.table_variances, training.table_steps)
    columns = moment_columns(settings)
    yield from _pack_squares(
        MOMENTS,
        region,
        settings,
        fields_of=lambda number, rows: _pack_columns(
            columns, [moment[number][rows] for moment in moments]
        ),
    )
    for number, first in enumerate(range(0, len(training.sample_points), SAMPLES_PER_PART)):
        rows = slice(first, first + SAMPLES_PER_PART)
        samples = [training.sample_points[rows], training.sample_labels[rows]]
        key = PartKey(SAMPLES, region.index, cell=number)
        yield _region_part(key, _pack_columns(SAMPLE_COLUMNS, samples))
    yield from _pack_rays(region, training.rays)


def _pack_rays(region: Region, rays: ReplayRays) -> Iterator[Part]:
    codes = rays.leaf_codes
    cells = codes >> leaf_shift()
    for cell in np.unique(cells).tolist():
        of_cell = _rows_of(cells, cell)
        for number, first in enumerate(range(of_cell.start, of_cell.stop, RAYS_PER_PART)):
            rows = slice(first, min(first + RAYS_PER_PART, of_cell.stop))
            leaves, counts = np.unique(codes[rows], return_counts=True)
            fields = {
                "codes": pack_array(shuffle_codes(leaves - (cell << leaf_shift()))),
                "counts": pack_array(shuffle_counts(counts)),
                "inside": pack_array((rays.ends[rows] % STEPS).astype(np.uint8).T.copy()),
                "origins": pack_array(shuffle_counts(rays.origin_of[rows].astype(np.int64))),
                "slopes": pack_array(rays.slopes[rows]),
            }
            yield _region_part(PartKey(RAYS, region.index, plane=number, cell=cell), fields)
