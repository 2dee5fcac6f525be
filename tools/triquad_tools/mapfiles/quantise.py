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
from dataclasses import dataclass

import numpy as np
from triquad_format.errors import FormatError
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MAX_INTEGER, MapRecord, Region, VertexTable, masked
from triquad_map.record_view import open_view

from triquad_tools.mapfiles.field_change import FieldChange, draw_probes, field_change

_SEARCH_SEED, _MEASURE_SEED = 0, 1
_QUANTILE_PER_RMS = 3.2  # of the changes; seen 3.1 to 3.3; only where the search begins
_MARGIN = 0.95  # of the limit: quantiles at other points differ by some percent
_CLOSE, _AIM = 0.97, 0.985  # of the limit within that margin: where the search ends, and its aim
_EVALUATIONS_MAX = 16
_NOISE = 0.01  # in features, to see how much they move distances: about what rounding does
_GROWTH_MAX = 8.0  # of the factor from one evaluation to the next


@dataclass(frozen=True)
class QuantisedMap:
    """A map with integer features."""

    record: MapRecord  # without training state: it would not fit the rounded features
    change: FieldChange  # from the map that it was made of, measured at points of their own


def quantise(record: MapRecord, max_error_m: float) -> QuantisedMap:
    """Return the coarsest integer features of which 99 of 100 distances are off by ``max_error_m``.

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
    """Return the map with float32 features where it has integers; it answers as before."""
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
    probes = _RegionProbes(settings, region)
    limit = _MARGIN * max_error_m
    weights = _relative_scales(settings, region.tables, probes)
    # Where the formula of the module's head predicts the error.
    vertices = max(sum(len(table.codes) for table in region.tables), 1)
    factor = limit / (_QUANTILE_PER_RMS * math.sqrt(settings.feature_size * vertices / 27))
    best, error = None, 0.0
    for _ in range(_EVALUATIONS_MAX):
        tables = tuple(
            _rounded(table, factor * weight)
            for table, weight in zip(region.tables, weights, strict=True)
        )
        error = probes.points.change(probes.moves(tables)).quantile_m
        if error <= limit:
            best = tables
            if error >= _CLOSE * limit or error == 0.0:
                break
        factor *= min(_AIM * limit / max(error, 1e-12), _GROWTH_MAX)
    if best is None:
        raise FormatError(
            f"region {region.index}: integers change distances by {error * 1e3:.3f} mm, "
            f"more than {max_error_m * 1e3:.3f} mm; allow a larger error"
        )
    return dataclasses.replace(region, tables=best, training=None)


def _rounded(table: VertexTable, scale: float) -> VertexTable:
    """Return the nearest integers; the scale grows where the largest feature needs it."""
    vectors = table.vectors()
    least = float(np.abs(vectors).max(initial=0.0)) / MAX_INTEGER
    used = np.float32(max(scale, least * (1 + 1e-6), float(np.finfo(np.float32).tiny)))
    integers = np.rint(vectors / used).astype(np.int16)
    return dataclasses.replace(table, features=integers, scale=float(used))


class _RegionProbes:
    """One region's field at points where rays have been, asked again with other features."""

    def __init__(self, settings: FieldSettings, region: Region) -> None:
        # At the origin, alone and without evidence: no more than its field is asked.
        alone = dataclasses.replace(
            region, index=(0, 0, 0), evidence=masked(region.evidence, np.uint8(0)), training=None
        )
        self._record = MapRecord("", 0, settings, regions=(alone,))
        self.points = draw_probes(settings, region, np.random.default_rng(_SEARCH_SEED))
        self._before = self._distances(region.tables)

    def moves(self, tables: tuple[VertexTable, ...]) -> Floats:
        """Return how far distances move [P], metres, where the region has these tables."""
        return self._distances(tables) - self._before

    def _distances(self, tables: tuple[VertexTable, ...]) -> Floats:
        """Return signed distances [P], metres; 0 outside the region's cube."""
        region = dataclasses.replace(self._record.regions[0], tables=tables)
        opened = open_view(dataclasses.replace(self._record, regions=(region,)))
        try:
            return np.nan_to_num(opened.query(self.points.points).sdf)
        finally:
            opened.close()


def _relative_scales(
    settings: FieldSettings, tables: tuple[VertexTable, ...], probes: _RegionProbes
) -> list[float]:
    """Return ``sqrt(V) / g`` of each table; ``g`` from the effect of noise in its level."""
    rng = np.random.default_rng(_SEARCH_SEED)
    rms = {}
    for level in settings.levels:
        noisy = tuple(_noisy(t, rng) if t.level == level else t for t in tables)
        moves = probes.moves(noisy)
        rms[level] = float(np.linalg.norm(moves)) / math.sqrt(max(len(moves), 1))
    least = 1e-3 * max(rms.values()) or 1.0  # no level may become arbitrarily coarse
    # Three planes of the level move distances by this.
    per_slope = _NOISE * math.sqrt(settings.feature_size / 9)
    return [
        math.sqrt(len(table.codes)) / (max(rms[table.level], least) / per_slope) for table in tables
    ]


def _noisy(table: VertexTable, rng: np.random.Generator) -> VertexTable:
    vectors = table.vectors()
    noise = rng.uniform(-_NOISE / 2, _NOISE / 2, vectors.shape)
    return dataclasses.replace(table, features=vectors + noise.astype(np.float32), scale=None)
