"""The surfels of a region at one epoch, kept up to date from those of the epoch before."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles, Ints

from triquad_map.compiled.evidence.frozen_evidence import FrozenEvidence
from triquad_map.compiled.surfels.surfel_index import (
    SurfelPlaces,
    moved_rows,
    surfel_index,
    surfel_places,
)
from triquad_map.compiled.surfels.surfel_search import find_nearest
from triquad_map.nearest import NearestSurfels
from triquad_map.surface.confidence import support_confidence
from triquad_map.surface.surfels import SampleField, Surfels, fit_surfels

_NEVER = -1


@dataclass(frozen=True)
class SurfelTask:
    """What an update of surfels is to do."""

    epoch: int  # number of the epoch that they are for
    most: int | None  # surfels that are fitted again at most, new ones apart; None: all


@dataclass(frozen=True)
class _Fitted:
    """Surfels in their places, and the epoch in which each was fitted last."""

    places: SurfelPlaces
    surfels: Surfels
    epochs: Ints  # [S] ``_NEVER`` where there is nothing yet


class SurfelMap:
    """Immutable: epochs share it."""

    def __init__(self, evidence: FrozenEvidence, fitted: _Fitted) -> None:
        """Use :func:`first_surfels` or :meth:`updated`."""
        self._fitted = fitted
        self._index = surfel_index(fitted.places, fitted.surfels)
        self.confidence = support_confidence(evidence.levels, fitted.surfels.kinds)
        self.seen_s = np.repeat(evidence.seen_s, np.diff(fitted.places.starts))

    def __len__(self) -> int:
        return len(self._fitted.epochs)

    def find_nearest(self, points: Doubles, found: NearestSurfels) -> None:
        """Improve ``found`` where a surfel lies nearer to leaf coordinates ``points`` [N, 3]."""
        find_nearest(points, self._index, found)

    def updated(
        self, evidence: FrozenEvidence, field: SampleField, task: SurfelTask
    ) -> "SurfelMap":
        """The surfels of a later epoch: new ones are fitted, and of the others the oldest."""
        return _fitted_again(evidence, _carried(self._fitted, evidence), field, task)


def first_surfels(evidence: FrozenEvidence, field: SampleField, task: SurfelTask) -> SurfelMap:
    """The surfels of all seen voxels."""
    places = surfel_places(evidence.cells, evidence.surface)
    return _fitted_again(evidence, _nothing_in(places), field, task)


def _nothing_in(places: SurfelPlaces) -> _Fitted:
    count = len(places.voxels)
    offsets, normals = np.zeros((2, count, 3), np.float32)
    surfels = Surfels(offsets, normals, np.zeros(count, np.uint8))
    return _Fitted(places, surfels, np.full(count, _NEVER, np.int32))


def _carried(before: _Fitted, evidence: FrozenEvidence) -> _Fitted:
    """Copies of surfels in the places of later evidence."""
    old = before.places
    if np.array_equal(old.surface, evidence.surface):
        copies = {name: array.copy() for name, array in vars(before.surfels).items()}
        return _Fitted(old, Surfels(**copies), before.epochs.copy())
    after = _nothing_in(surfel_places(evidence.cells, evidence.surface))
    rows = moved_rows(old.surface, old.starts, after.places.surface, len(after.epochs))
    kept = np.flatnonzero(rows >= 0)
    rows = rows[kept]
    for name, array in vars(after.surfels).items():
        array[kept] = getattr(before.surfels, name)[rows]
    after.epochs[kept] = before.epochs[rows]
    return after


def _fitted_again(
    evidence: FrozenEvidence, fitted: _Fitted, field: SampleField, task: SurfelTask
) -> SurfelMap:
    """Fit what was never fitted, and as much of the rest as the task says; changes ``fitted``."""
    known = np.flatnonzero(fitted.epochs != _NEVER)
    if task.most is not None and len(known) > task.most:
        known = known[np.argpartition(fitted.epochs[known], task.most)[: task.most]]
    chosen = np.concatenate([np.flatnonzero(fitted.epochs == _NEVER), known])
    new = fit_surfels(fitted.places.voxels[chosen], field, evidence.ended_in)
    for name, array in vars(new).items():
        getattr(fitted.surfels, name)[chosen] = array
    fitted.epochs[chosen] = task.epoch
    return SurfelMap(evidence, fitted)
