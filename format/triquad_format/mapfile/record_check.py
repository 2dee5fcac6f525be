"""The check that a map record is valid, made before it is written and after it is read."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import FormatError
from triquad_format.records import morton
from triquad_format.records.arrays import Longs
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings
from triquad_format.records.region import (
    AXES,
    BLOCK_BYTES,
    FLOATS,
    MARGIN_BITS,
    MAX_INTEGER,
    MAX_LEVEL,
    MAX_SEEN_S,
    MLP_LAYERS,
    OUTCOME_BITS,
    Evidence,
    MapRecord,
    Region,
    TrainingState,
    VertexTable,
    surface_counts,
)
from triquad_format.records.replay_rays import STEPS, ReplayRays
from triquad_format.wire.keys import check_name
from triquad_format.wire.limits import MAX_POSITION_M
from triquad_format.wire.packing import ArraySpec


def check_record(record: MapRecord) -> None:
    """Raise :class:`FormatError`, naming region and field, unless ``record`` is valid."""
    check_name("map", record.name)
    _check_count("epoch", record.epoch)
    record.progress.check()
    if len(record.origin_m) != 3 or not np.abs(record.origin_m).max() <= MAX_POSITION_M:
        raise FormatError(f"origin_m = {record.origin_m} is no place")
    indices = [region.index for region in record.regions]
    if len(set(indices)) != len(indices):
        raise FormatError("two regions have the same index")
    for region in record.regions:
        check_region(record.settings, region)


def check_region(settings: FieldSettings, region: Region) -> None:
    """Raise :class:`FormatError`, naming region and field, unless ``region`` is valid."""
    try:
        _check_region(settings, region)
    except FormatError as error:
        raise FormatError(f"region {region.index}: {error}") from error


def _check_region(settings: FieldSettings, region: Region) -> None:
    if len(region.index) != 3 or any(not -(2**31) < number < 2**31 for number in region.index):
        raise FormatError("the index is out of range")
    _check_floats("frequencies", region.frequencies, (settings.frequencies,))
    shapes = _mlp_shapes(settings)
    _check_arrays("mlp weights", region.mlp.weights, shapes[:MLP_LAYERS])
    _check_arrays("mlp biases", region.mlp.biases, shapes[MLP_LAYERS:])
    places = [(plane, level) for plane in range(len(AXES)) for level in settings.levels]
    if [(table.plane, table.level) for table in region.tables] != places:
        raise FormatError("the vertex tables are not those of the settings")
    if len({table.scale is None for table in region.tables}) > 1:
        raise FormatError("some tables have integer features, others have not")
    for table in region.tables:
        _check_table(settings, table)
    _check_evidence(settings, region.evidence)
    if region.training is not None:
        _check_training(settings, region, region.training)


def _mlp_shapes(settings: FieldSettings) -> list[tuple[int, ...]]:
    """Return shapes of the MLP's arrays: weights, then biases."""
    hidden = settings.hidden
    weights = [(settings.input_size, hidden), (hidden, hidden), (hidden, 1)]
    return [*weights, (hidden,), (hidden,), (1,)]


def _check_table(settings: FieldSettings, table: VertexTable) -> None:
    name = f"plane {table.plane}, level {table.level}"
    _check_codes(f"{name} codes", table.codes)
    side = 1 << table.level
    beyond = table.codes[np.searchsorted(table.codes, side * side) :]  # the far edges, at most
    if morton.decode(beyond, 2).max(initial=0) > side:
        raise FormatError(f"{name} codes: a vertex lies outside the level")
    shape = (len(table.codes), settings.feature_size)
    if table.scale is None:
        _check_floats(f"{name} features", table.features, shape, dtypes=FLOATS)
        return
    ArraySpec("<i2", shape).check(f"{name} features", table.features)
    in_range = 0 < table.scale <= float(np.finfo(np.float32).max)
    if not in_range or float(np.float32(table.scale)) != table.scale:
        raise FormatError(
            f"{name}: a scale of {table.scale} is not a positive number of single precision"
        )
    if np.abs(table.features.astype(np.int32)).max(initial=0) > MAX_INTEGER:
        raise FormatError(f"{name}: an integer exceeds {MAX_INTEGER}")


def _check_evidence(settings: FieldSettings, evidence: Evidence) -> None:
    _check_codes("evidence codes", evidence.codes)
    side = (1 << settings.depth) // BLOCK_VOXELS
    if len(evidence.codes) and evidence.codes[-1] >= side**3:
        raise FormatError("evidence codes: a block lies outside the region")
    masks = ArraySpec("|u1", (len(evidence.codes), BLOCK_BYTES))
    masks.check("evidence surface", evidence.surface)
    masks.check("evidence free", evidence.free)
    counts = surface_counts(evidence.surface)
    ArraySpec("|u1", (int(counts.sum()),)).check("evidence levels", evidence.levels)
    if evidence.levels.max(initial=0) > MAX_LEVEL:
        raise FormatError(f"evidence levels: one exceeds {MAX_LEVEL}")
    for name, codes, bits in (
        ("outcomes", evidence.outcomes, OUTCOME_BITS),
        ("margins", evidence.margins, MARGIN_BITS),
    ):
        ArraySpec("|u1", (int(counts.sum()), len(bits))).check(f"evidence {name}", codes)
        if (codes >> np.array(bits, np.uint8)).any():
            raise FormatError(f"evidence {name}: a code exceeds {bits} bits")
    ArraySpec("<i8", counts.shape).check("evidence seen_s", evidence.seen_s)
    low, high = evidence.seen_s.min(initial=0), evidence.seen_s.max(initial=0)
    if low < 0 or high > MAX_SEEN_S:
        raise FormatError(f"evidence seen_s: a time lies outside of 0 to {MAX_SEEN_S} s")
    if evidence.seen_s[counts == 0].any():
        raise FormatError("evidence seen_s: a block without surface has a time")


def _check_training(settings: FieldSettings, region: Region, training: TrainingState) -> None:
    columns = (training.table_means, training.table_variances, training.table_steps)
    if any(len(column) != len(region.tables) for column in columns):
        raise FormatError("the training state does not have one entry per vertex table")
    for table, mean, variance, steps in zip(region.tables, *columns, strict=True):
        shape = (len(table.codes), settings.feature_size)
        _check_floats("table means", mean, shape, dtypes=FLOATS)
        _check_floats("table variances", variance, shape, dtypes=FLOATS, low=0.0)
        ArraySpec("<i4", shape[:1]).check("table steps", steps)
        if steps.min(initial=0) < 0:
            raise FormatError("table steps: a number is negative")
    _check_arrays("mlp means", training.mlp_means, _mlp_shapes(settings))
    _check_arrays("mlp variances", training.mlp_variances, _mlp_shapes(settings), low=0.0)
    _check_count("mlp steps", training.mlp_steps, 2**31)
    _check_count("training budget", training.budget_samples)
    samples = len(training.sample_points)
    _check_floats("sample points", training.sample_points, (samples, 3))
    if np.abs(training.sample_points).max(initial=0) > settings.region_side_m:
        raise FormatError("sample points: one lies far outside its region")
    _check_floats("sample labels", training.sample_labels, (samples,), dtypes=FLOATS)
    _check_rays(settings, training.rays)


def _check_rays(settings: FieldSettings, rays: ReplayRays) -> None:
    _check_floats("ray origins", rays.origins, (len(rays.origins), 3))
    ArraySpec("<i4", (len(rays), 3)).check("ray ends", rays.ends)
    ArraySpec("<i4", (len(rays),)).check("ray origins of ends", rays.origin_of)
    ArraySpec("|u1", (len(rays),)).check("ray slopes", rays.slopes)
    if not len(rays):
        return
    if rays.ends.min() < 0 or rays.ends.max() >= STEPS << settings.depth + 1:
        raise FormatError("ray ends: one lies far outside its region")
    if rays.origin_of.min() < 0 or rays.origin_of.max() >= len(rays.origins):
        raise FormatError("ray origins of ends: one is not among the origins")
    codes = rays.leaf_codes
    if (codes[1:] < codes[:-1]).any():
        raise FormatError("ray ends: they are not in the order of their leaves")


def _check_count(name: str, count: int, limit: int = 2**63) -> None:
    if not 0 <= count < limit:
        raise FormatError(f"{name} = {count} is not a count")


def _check_codes(name: str, codes: Longs) -> None:
    ArraySpec("<i8", (None,)).check(name, codes)
    if len(codes) and (codes[0] < 0 or (codes[1:] <= codes[:-1]).any()):
        raise FormatError(f"{name}: not strictly increasing from 0 on")


def _check_arrays(
    name: str,
    arrays: Sequence[NDArray[np.floating]],
    shapes: list[tuple[int, ...]],
    low: float = -np.inf,
) -> None:
    if len(arrays) != len(shapes):
        raise FormatError(f"{name}: {len(arrays)} arrays, expected {len(shapes)}")
    for i, (array, shape) in enumerate(zip(arrays, shapes, strict=True)):
        _check_floats(f"{name} [{i}]", array, shape, low=low)


def _check_floats(
    name: str,
    array: NDArray[np.floating | np.int16],
    shape: tuple[int, ...],
    *,
    dtypes: tuple[str, ...] = ("<f4",),
    low: float = -np.inf,
) -> None:
    dtype = array.dtype.str if array.dtype.str in dtypes else dtypes[-1]
    ArraySpec(dtype, shape).check(name, array)
    if not np.isfinite(array).all():
        raise FormatError(f"{name}: a value is not finite")
    if low > -np.inf and array.min(initial=0.0) < low:
        raise FormatError(f"{name}: a value is below {low:g}")
