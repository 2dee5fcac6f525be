"""Features as integers times a step, as coarse as an error of the distances allows.

The step of a table (a plane and level) grows with the square root of its vertices: of all steps
that move distances by the same error, those take nearly the fewest bits (searched for each table
by its own effect on distances, files were 2 to 3 % smaller). What the steps share, one factor, is
searched for by evaluating the map.
"""

import dataclasses
import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from triquad_format.errors import FormatError
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.region import MAX_INTEGER, MapRecord, VertexTable, seen_voxels
from triquad_map.opening import open_view

_SEARCH_SEED, _MEASURE_SEED = 0, 1
_FIRST_STEP = 1e-3  # in features of a table of one vertex; only where the search begins
_MARGIN = 0.95  # of the limit: quantiles at other points differ by some percent
_CLOSE, _AIM = 0.97, 0.985  # of the limit within that margin: where the search ends, and its aim
_EVALUATIONS_MAX = 16
_GROWTH_MAX = 8.0  # of the steps from one evaluation to the next

_PROBES, _LEAST_PROBES = 40_000, 2_000  # points in all, and at least in each region
_NEAR_LEAVES = 1.5  # of these points, from the middle of a surface voxel, on each axis


@dataclass(frozen=True)
class FieldChange:
    """Magnitudes of the change of the distance near surface, metres."""

    quantile_m: float  # what 99 of 100 keep below
    largest_m: float


@dataclass(frozen=True)
class QuantisedMap:
    """A map with integer features."""

    record: MapRecord  # without training state: it would not fit the rounded features
    change: FieldChange  # from the map that it was made of, measured at points of their own


def quantise(record: MapRecord, max_error_m: float) -> QuantisedMap:
    """Return the coarsest integer features of which 99 of 100 distances are off by ``max_error_m``.

    Args:
        record: the map; it may have integer features already, the error is from those.
        max_error_m: metres.

    Raises:
        FormatError: even the finest integers change distances by more.
    """
    change_of, limit = _changes(record, _SEARCH_SEED), _MARGIN * max_error_m
    step, best, error = _FIRST_STEP, None, 0.0
    for _ in range(_EVALUATIONS_MAX):
        rounded = _rounded(record, step)
        error = change_of(rounded).quantile_m
        if error <= limit:
            best = rounded
            if error >= _CLOSE * limit or error == 0.0:
                break
        step *= min(_AIM * limit / max(error, 1e-12), _GROWTH_MAX)
    if best is None:
        raise FormatError(
            f"integers change distances by {error * 1e3:.3f} mm, more than "
            f"{max_error_m * 1e3:.3f} mm; allow a larger error"
        )
    return QuantisedMap(best, field_change(record, best, _MEASURE_SEED))


def field_change(before: MapRecord, after: MapRecord, seed: int) -> FieldChange:
    """Return how far distances moved between two maps that have the same regions and evidence."""
    return _changes(before, seed)(after)


def _changes(before: MapRecord, seed: int) -> Callable[[MapRecord], FieldChange]:
    """Return what measures how far the distances of other maps are from those of this one."""
    points = probes(before, seed)
    old = _distances(before, points)

    def change(after: MapRecord) -> FieldChange:
        # Outside the cube of a region at the map's border there is no distance.
        moved = np.abs(np.nan_to_num(_distances(after, points) - old))
        quantile_m = float(np.quantile(moved, 0.99)) if len(moved) else 0.0
        return FieldChange(quantile_m, largest_m=float(moved.max(initial=0.0)))

    return change


def probes(record: MapRecord, seed: int) -> Doubles:
    """Return random points [N, 3] near seen surface, map frame, metres."""
    rng, settings = np.random.default_rng(seed), record.settings
    count = max(_PROBES // max(len(record.regions), 1), _LEAST_PROBES)
    middle = (1 << (settings.depth - 1)) - 0.5
    parts = [np.zeros((0, 3))]
    for region in record.regions:
        voxels = seen_voxels(region.evidence, region.evidence.surface)
        if len(voxels):
            leaves = voxels[rng.integers(len(voxels), size=count)] - middle
            leaves = leaves + rng.uniform(-_NEAR_LEAVES, _NEAR_LEAVES, leaves.shape)
            parts.append(leaves * settings.leaf_m + settings.region_centre(region.index))
    return np.concatenate(parts)


def _distances(record: MapRecord, points: Doubles) -> Floats:
    with closing(open_view(record)) as view:
        return view.query(points).sdf


def _rounded(record: MapRecord, step: float) -> MapRecord:
    regions = (
        dataclasses.replace(
            region, tables=tuple(_integers(table, step) for table in region.tables), training=None
        )
        for region in record.regions
    )
    return dataclasses.replace(record, regions=tuple(regions))


def _integers(table: VertexTable, step: float) -> VertexTable:
    """Return the nearest integers; the scale grows where the largest feature needs it."""
    vectors = table.vectors()
    least = float(np.abs(vectors).max(initial=0.0)) / MAX_INTEGER * (1 + 1e-6)
    wanted = step * math.sqrt(len(table.codes))
    scale = np.float32(max(wanted, least, float(np.finfo(np.float32).tiny)))
    integers = np.rint(vectors / scale).astype(np.int16)
    return dataclasses.replace(table, features=integers, scale=float(scale))
