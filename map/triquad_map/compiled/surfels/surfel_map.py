"""The surfels of a region at one epoch, kept up to date from those of the epoch before."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_map.compiled.evidence.evidence import Evidence
from triquad_map.compiled.surfels.surfel_index import (
    SurfelPlaces,
    moved_rows,
    surfel_index,
    surfel_places,
)
from triquad_map.compiled.surfels.surfel_search import find_nearest
from triquad_map.nearest import NearestSurfels
from triquad_map.surface.confidence import support_confidence
from triquad_map.surface.surfels import FieldSample, Surfels, fit_surfels

_NEVER = -1

SampleField = Callable[[NDArray[np.float64]], FieldSample]


@dataclass(frozen=True)
class SurfelTask:
    """What an update of surfels is to do."""

    epoch: int  # number of the epoch that they are for
    most: int | None  # surfels that are fitted again at most, new ones apart; None: all


class SurfelMap:
    """Immutable: epochs share it."""

    def __init__(
        self,
        places: SurfelPlaces,
        evidence: Evidence,
        surfels: Surfels,
        fitted: NDArray[np.int32],
    ) -> None:
        """Use :func:`first_surfels` or :meth:`updated`; ``fitted`` are epochs of the last fit."""
        self._places = places
        self._surfels = surfels
        self._fitted = fitted
        self._index = surfel_index(places, surfels)
        self.confidence = support_confidence(evidence.levels(), surfels.kinds)
        self.seen_s = np.repeat(evidence.seen_s(), np.diff(places.starts))

    def __len__(self) -> int:
        return len(self._surfels.kinds)

    def find_nearest(self, points: NDArray[np.float64], found: NearestSurfels) -> None:
        """Improve ``found`` where a surfel lies nearer to leaf coordinates ``points`` [N, 3]."""
        find_nearest(points, self._index, found)

    def updated(self, evidence: Evidence, field: SampleField, task: SurfelTask) -> "SurfelMap":
        """The surfels of a later epoch: new ones are fitted, and of the others the oldest."""
        places, surfels, fitted = self._carried(evidence)
        known = np.flatnonzero(fitted != _NEVER)
        if task.most is not None and len(known) > task.most:
            known = known[np.argpartition(fitted[known], task.most)[: task.most]]
        chosen = np.concatenate([np.flatnonzero(fitted == _NEVER), known])
        new = fit_surfels(places.voxels[chosen], field, evidence.ended_in)
        for name, array in vars(new).items():
            getattr(surfels, name)[chosen] = array
        fitted[chosen] = task.epoch
        return SurfelMap(places, evidence, surfels, fitted)

    def _carried(self, evidence: Evidence) -> tuple[SurfelPlaces, Surfels, NDArray[np.int32]]:
        """Copies of the surfels in the places of ``evidence``, and when they were fitted last."""
        before = self._places
        if np.array_equal(before.surface, evidence.surface):
            copies = {name: array.copy() for name, array in vars(self._surfels).items()}
            return before, Surfels(**copies), self._fitted.copy()
        places = surfel_places(evidence.cells, evidence.surface)
        total = len(places.voxels)
        rows = moved_rows(before.surface, before.starts, places.surface, total)
        kept = np.flatnonzero(rows >= 0)
        rows = rows[kept]
        surfels, fitted = _empty(total), np.full(total, _NEVER, np.int32)
        for name, array in vars(surfels).items():
            array[kept] = getattr(self._surfels, name)[rows]
        fitted[kept] = self._fitted[rows]
        return places, surfels, fitted


def first_surfels(evidence: Evidence, field: SampleField, task: SurfelTask) -> SurfelMap:
    """The surfels of all seen voxels."""
    nothing = Evidence(1)
    places = surfel_places(nothing.cells, nothing.surface)
    none = SurfelMap(places, nothing, _empty(0), np.zeros(0, np.int32))
    return none.updated(evidence, field, task)


def _empty(count: int) -> Surfels:
    return Surfels(
        np.zeros((count, 3), np.float32),
        np.zeros((count, 3), np.float32),
        np.zeros(count, np.uint8),
    )
