"""The surfels of a region, and the nearest of them: the reference for compiled code."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Doubles, Floats, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import Evidence, seen_voxels, surface_counts

from triquad_map.composition.region import NearestSurfels, RegionFrame, no_surfels
from triquad_map.reference.seen_blocks import SeenBlocks
from triquad_map.surface import (
    DISC_RADIUS,
    HALF_LIFE_S,
    OUTSIDE,
    SMOOTHING,
    SampleField,
    SurfelKind,
    Surfels,
    fit_surfels,
    support_confidence,
)
from triquad_map.view import NO_LENGTH_M, NearestSurface

_PAIRS = 1 << 19
"""Points with blocks or surfels that are compared together: what bounds the memory."""


class SurfelCloud:
    """Surfels by blocks of voxels."""

    def __init__(self, voxels: Longs, surfels: Surfels, confidence: Floats, seen_s: Longs) -> None:
        """Take ``surfels`` of ``voxels`` [S, 3], of which those of a block follow each other.

        Each has a ``confidence`` [S], and was ``seen_s`` [S] last, seconds since 1970.
        """
        self._surfels = surfels
        self._confidence = confidence
        self._seen_s = seen_s
        kept = np.flatnonzero(surfels.kinds != SurfelKind.NONE)
        self._rows = kept
        self._positions = voxels[kept] + 0.5 + surfels.offsets[kept]
        self._normals = surfels.normals[kept].astype(np.float64)
        self._discs = np.isin(surfels.kinds[kept], (SurfelKind.DISC, SurfelKind.RAY_DISC))
        cells = voxels[kept] // BLOCK_VOXELS
        first = np.ones(len(cells), np.bool_)
        first[1:] = (cells[1:] != cells[:-1]).any(axis=1)
        self._starts = np.append(np.flatnonzero(first), len(cells))
        self._corners = cells[first] * BLOCK_VOXELS

    def __len__(self) -> int:
        return len(self._confidence)

    def find_nearest(self, points: Doubles, found: NearestSurfels) -> None:
        """Improve ``found`` where a surfel lies nearer to ``points`` [N, 3], voxels."""
        count = len(points)
        blocks = len(self._corners)
        if not blocks:
            return
        step = max(1, _PAIRS // blocks)
        for first in range(0, count, step):
            part = np.arange(first, min(first + step, count))
            gaps = self._block_gaps(points[part])
            # The nearest block first: for what it contains, most others need no search.
            nearest = np.zeros(gaps.shape, np.bool_)
            nearest[np.arange(len(part)), gaps.argmin(axis=1)] = True
            limits = found.distances[part, None]
            self._improve(found, points, part, chosen=nearest & (gaps < limits))
            reach = found.distances[part, None] + SMOOTHING
            self._improve(found, points, part, chosen=gaps <= reach)

    def improve(self, nearest: NearestSurface, points: Doubles, frame: RegionFrame) -> None:
        """Improve ``nearest`` where a surfel lies nearer to ``points`` [N, 3] of the map frame."""
        places = (points - frame.corner) / frame.leaf_m
        found = no_surfels(nearest.distance / frame.leaf_m)
        self.find_nearest(places, found)
        rows = np.flatnonzero(found.rows >= 0)
        surfels = found.rows[rows]
        away = places[rows] - found.means[rows]
        lengths = np.linalg.norm(away, axis=1, keepdims=True)
        age_s = np.maximum(frame.newest_s - self._seen_s[surfels], 0)
        kinds = self._surfels.kinds[surfels]
        facing = (kinds == SurfelKind.RAY_DISC)[:, None]
        nearest.found[rows] = True
        nearest.distance[rows] = found.distances[rows] * frame.leaf_m
        nearest.point[rows] = found.closest[rows] * frame.leaf_m + frame.corner
        nearest.gradient[rows] = np.where(
            lengths * frame.leaf_m > NO_LENGTH_M, away / np.maximum(lengths, NO_LENGTH_M), 0.0
        )
        nearest.confidence[rows] = self._confidence[surfels] * np.exp2(age_s / -HALF_LIFE_S)
        nearest.learnt[rows] = kinds < SurfelKind.RAY_DISC
        nearest.normal[rows] = np.where(facing, self._surfels.normals[surfels], 0.0)

    def _block_gaps(self, points: Doubles) -> Doubles:
        """Return how far [N, B] the surfels of each block are at least from each point."""
        squares = np.zeros((len(points), len(self._corners)))
        for axis in range(3):
            low = self._corners[:, axis] - points[:, axis, None]
            beyond = np.maximum(low, -low - BLOCK_VOXELS)
            squares += np.maximum(beyond, 0.0) ** 2
        return np.asarray(np.sqrt(squares) - OUTSIDE, np.float64)

    def _improve(
        self, found: NearestSurfels, points: Doubles, part: NDArray[np.intp], chosen: Bools
    ) -> None:
        """Compare the surfels of the ``chosen`` [len(part), B] blocks of some points."""
        sizes = np.diff(self._starts)
        for some in _portions(chosen.astype(np.int64) @ sizes):
            owners, blocks = np.nonzero(chosen[some])
            if not len(owners):
                continue
            owners = np.repeat(part[some][owners], sizes[blocks])
            ends = np.cumsum(sizes[blocks])
            within = np.arange(ends[-1]) - np.repeat(ends - sizes[blocks], sizes[blocks])
            surfels = np.repeat(self._starts[blocks], sizes[blocks]) + within
            self._take(found, points, owners=owners, surfels=surfels)

    def _take(
        self,
        found: NearestSurfels,
        points: Doubles,
        owners: NDArray[np.intp],
        surfels: NDArray[np.intp],
    ) -> None:
        """Let ``surfels`` [P] count for the points ``owners`` [P], which are in order."""
        closest = self._closest_points(points[owners], surfels)
        distances = np.linalg.norm(points[owners] - closest, axis=1)
        starts = np.flatnonzero(np.append(True, owners[1:] != owners[:-1]))
        counts = np.diff(np.append(starts, len(owners)))
        best = np.minimum.reduceat(distances, starts)
        asked = owners[starts]
        nearer = best <= found.distances[asked]
        nearer &= (best < found.distances[asked]) | (found.rows[asked] >= 0)
        at_best = np.flatnonzero(distances == np.repeat(best, counts))
        winners = at_best[np.searchsorted(at_best, starts)]
        farther = distances - np.repeat(best, counts)
        weights = np.maximum(1.0 - farther / SMOOTHING, 0.0) ** 2
        sums = np.add.reduceat(weights[:, None] * closest, starts)
        means = sums / np.add.reduceat(weights, starts)[:, None]
        rows = asked[nearer]
        found.distances[rows] = best[nearer]
        found.closest[rows] = closest[winners[nearer]]
        found.means[rows] = means[nearer]
        found.rows[rows] = self._rows[surfels[winners[nearer]]]

    def _closest_points(self, points: Doubles, surfels: NDArray[np.intp]) -> Doubles:
        """Return the nearest point [P, 3] of each surfel to each point."""
        offsets = points - self._positions[surfels]
        normals = self._normals[surfels]
        heights = (offsets * normals).sum(axis=1, keepdims=True)
        lateral = offsets - heights * normals
        lengths = np.linalg.norm(lateral, axis=1, keepdims=True)
        within = lateral * np.minimum(1.0, DISC_RADIUS / np.maximum(lengths, 1e-9))
        reached = np.where(self._discs[surfels, None], within, 0.0)
        return np.asarray(self._positions[surfels] + reached, np.float64)


def _portions(sizes: Longs) -> Iterator[slice]:
    """Cut ``range(len(sizes))`` so that the sizes of a portion add up to little."""
    ends = np.cumsum(sizes)
    first = 0
    while first < len(sizes):
        before = ends[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(ends, before + _PAIRS, "right")))
        yield slice(first, last)
        first = last


def fitted_surfels(record: Evidence, seen: SeenBlocks, field: SampleField) -> SurfelCloud:
    """Return the surfels of all voxels in which rays ended; ``seen`` has what ``record`` has."""
    voxels = seen_voxels(record, record.surface)
    surfels = fit_surfels(voxels, field, seen.ended_in)
    seen_s = np.repeat(record.seen_s, surface_counts(record.surface))
    return SurfelCloud(voxels, surfels, support_confidence(record.levels, surfels.kinds), seen_s)
