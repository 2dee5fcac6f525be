"""Features as integers times a scale, as coarse as an error of the distances allows.

A vector is its integers times the scale of its table (a plane and level). Rounding with scales
``q_t`` moves the distance at a point by a random amount of variance

    sum over the tables t of  S * g_t**2 * (4 / 9) * q_t**2 / 12

(``S`` feature size, ``g_t`` rms derivative of the distance by a feature of the table's level,
4 / 9 the mean of the summed squares of the four hat weights), while a table of ``V_t`` vertices
costs ``-V_t * S * log2(q_t)`` bits and a constant. The least bits for a given error have
``q_t = factor * sqrt(V_t) / g_t``; the one ``factor`` left is searched for by evaluating.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from triquad_format.errors import FormatError
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MAX_INTEGER, MapRecord, Region, VertexTable

from triquad_tools.mapfiles.field_change import FieldChange, field_change
from triquad_tools.mapfiles.region_probes import RegionProbes

_SEARCH_SEED, _MEASURE_SEED = 0, 1
_QUANTILE_PER_RMS = 3.2  # of the changes; seen 3.1 to 3.3; only where the search begins
_MARGIN = 0.95  # of the limit: quantiles at other points differ by some percent
_CLOSE, _AIM = 0.97, 0.985  # of the limit within that margin: where the search ends, and its aim
_EVALUATIONS_MAX = 16
_GROWTH_MAX = 8.0  # of the factor from one evaluation to the next


@dataclass(frozen=True)
class QuantisedMap:
    """A map with integer features."""

    record: MapRecord  # without training state: it would not fit the rounded features
    change: FieldChange  # from the map that it was made of, measured at points of their own


def quantise(record: MapRecord, max_error_m: float) -> QuantisedMap:
    """The coarsest integer features of which 99 of 100 distances are off by ``max_error_m``.

    The limit holds in each region for each kind of points of :class:`FieldChange`.

    Args:
        record: the map; it may have integer features already, the error is from those.
        max_error_m: metres.

    Raises:
        FormatError: even the finest integers change distances by more.
    """
    regions = tuple(
        _quantise_region(record.settings, region, max_error_m) for region in record.regions
    )
    packed = dataclasses.replace(record, regions=regions)
    return QuantisedMap(packed, field_change(record, packed, _MEASURE_SEED))


def dequantised(record: MapRecord) -> MapRecord:
    """The map with float32 features where it has integers; it answers as before."""
    regions = tuple(
        dataclasses.replace(region, tables=tuple(map(_floats, region.tables)))
        for region in record.regions
    )
    return dataclasses.replace(record, regions=regions)


def _floats(table: VertexTable) -> VertexTable:
    if table.scale is None:
        return table
    return dataclasses.replace(table, features=table.vectors(), scale=None)


def _quantise_region(settings: FieldSettings, region: Region, max_error_m: float) -> Region:
    probes = RegionProbes(settings, region, np.random.default_rng(_SEARCH_SEED))
    limit = _MARGIN * max_error_m
    weights = _relative_scales(settings, region.tables, probes)
    factor = _first_factor(settings, region.tables, probes, limit)
    best, error = None, 0.0
    for _ in range(_EVALUATIONS_MAX):
        tables = tuple(
            _rounded(table, factor * weight)
            for table, weight in zip(region.tables, weights, strict=True)
        )
        error = probes.change([table.vectors() for table in tables]).quantile_m
        if error <= limit:
            best = tables
            if error >= _CLOSE * limit or error == 0.0:
                break
        factor *= min(_AIM * limit / max(error, 1e-12), _GROWTH_MAX)
    if best is None:
        raise FormatError(
            f"region {region.index}: integers change distances by {error * 1e3:.3f} mm, "
            f"more than {max_error_m * 1e3:.3f} mm; allow a larger error",
        )
    return dataclasses.replace(region, tables=best, training=None)


def _rounded(table: VertexTable, scale: float) -> VertexTable:
    """The nearest integers; the scale grows where the largest feature needs it."""
    vectors = table.vectors()
    least = float(np.abs(vectors).max(initial=0.0)) / MAX_INTEGER
    used = np.float32(max(scale, least * (1 + 1e-6), float(np.finfo(np.float32).tiny)))
    integers = np.rint(vectors / used).astype(np.int16)
    return dataclasses.replace(table, features=integers, scale=float(used))


def _relative_scales(
    settings: FieldSettings, tables: Sequence[VertexTable], probes: RegionProbes
) -> list[float]:
    """``sqrt(V) / g`` of each table."""
    slopes = probes.level_slopes
    least = 1e-3 * max(float(slopes.max()), 1e-12)  # no level may become arbitrarily coarse
    return [
        math.sqrt(len(table.codes)) / max(float(slopes[table.level - settings.levels.start]), least)
        for table in tables
    ]


def _first_factor(
    settings: FieldSettings, tables: Sequence[VertexTable], probes: RegionProbes, limit_m: float
) -> float:
    """The factor at which the formula of the module's head predicts the error."""
    slopes = probes.level_slopes
    weights = _relative_scales(settings, tables, probes)
    variance = sum(
        settings.feature_size * (weight * slopes[table.level - settings.levels.start]) ** 2 / 27
        for table, weight in zip(tables, weights, strict=True)
    )
    return limit_m / (_QUANTILE_PER_RMS * math.sqrt(max(float(variance), 1e-24)))
