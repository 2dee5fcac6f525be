"""The surfels of a region at one epoch, kept up to date from those of the epoch before."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.region import BLOCK_VOXELS
from triquad_query.confidence import POINT_SHARE, level_confidence
from triquad_query.surfels import FieldSample, SurfelKind, Surfels, fit_surfels

from triquad_kernels.evidence import Evidence
from triquad_kernels.surfel_index import (
    SurfelIndex,
    block_groups,
    moved_rows,
    surfel_starts,
    surfel_voxels,
)
from triquad_kernels.surfel_search import Nearest, find_nearest

_FAR = 1e6  # voxels
_NEVER = -1

SampleField = Callable[[NDArray[np.float64]], FieldSample]


@dataclass(frozen=True)
class SurfelTask:
    """What an update of surfels is to do."""

    epoch: int  # number of the epoch that they are for
    most: int | None  # surfels that are fitted again at most, new ones apart; None: all


class SurfelMap:
    """Immutable: epochs share it."""

    def __init__(self, evidence: Evidence, surfels: Surfels, fitted: NDArray[np.int32]) -> None:
        """Use :func:`first_surfels` or :meth:`updated`; ``fitted`` are epochs of the last fit."""
        self._surfels = surfels
        self._fitted = fitted
        self._surface = evidence.surface
        starts = surfel_starts(self._surface)
        voxels = surfel_voxels(evidence.cells, self._surface, len(surfels.kinds))
        positions = (voxels % BLOCK_VOXELS + 0.5 + surfels.offsets).astype(np.float32)
        positions[surfels.kinds == SurfelKind.NONE] = _FAR
        self._index = SurfelIndex(
            block_groups(evidence.cells, self._surface),
            starts,
            np.ascontiguousarray(positions.T),
            surfels.normals,
            surfels.kinds,
        )
        shares = np.where(surfels.kinds == SurfelKind.POINT, POINT_SHARE, 1.0)
        self.confidence = (level_confidence()[evidence.levels()] * shares).astype(np.float32)
        self.seen_s = np.repeat(evidence.seen_s(), np.diff(starts))

    def __len__(self) -> int:
        return len(self._surfels.kinds)

    def find_nearest(self, points: NDArray[np.float64], found: Nearest) -> None:
        """Improve ``found`` where a surfel lies nearer to leaf coordinates ``points`` [N, 3]."""
        find_nearest(points, self._index, found)

    def updated(self, evidence: Evidence, field: SampleField, task: SurfelTask) -> "SurfelMap":
        """The surfels of a later epoch: new ones are fitted, and of the others the oldest."""
        total = int(surfel_starts(evidence.surface)[-1])
        rows = moved_rows(self._surface, self._index.starts, evidence.surface, total)
        known = rows >= 0
        fitted = np.full(total, _NEVER, np.int32)
        fitted[known] = self._fitted[rows[known]]
        surfels = _empty(total)
        for name, array in vars(surfels).items():
            array[known] = getattr(self._surfels, name)[rows[known]]
        chosen = np.flatnonzero(known)
        if task.most is not None and len(chosen) > task.most:
            chosen = chosen[np.argpartition(fitted[chosen], task.most)[: task.most]]
        chosen = np.concatenate([np.flatnonzero(~known), chosen])
        voxels = surfel_voxels(evidence.cells, evidence.surface, total)[chosen]
        for name, array in vars(fit_surfels(voxels, field, evidence.ended_in)).items():
            getattr(surfels, name)[chosen] = array
        fitted[chosen] = task.epoch
        return SurfelMap(evidence, surfels, fitted)


def first_surfels(evidence: Evidence, field: SampleField, task: SurfelTask) -> SurfelMap:
    """The surfels of all seen voxels."""
    none = SurfelMap(Evidence(1), _empty(0), np.zeros(0, np.int32))
    return none.updated(evidence, field, task)


def _empty(count: int) -> Surfels:
    return Surfels(
        np.zeros((count, 3), np.float32),
        np.zeros((count, 3), np.float32),
        np.zeros(count, np.uint8),
    )
