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
    Nearest,
    SurfelIndex,
    block_groups,
    find_nearest,
    moved_rows,
    surfel_starts,
    surfel_voxels,
)

_FAR = 1e6  # voxels

SampleField = Callable[[NDArray[np.float64]], FieldSample]


@dataclass(frozen=True)
class _States:
    """What is kept of each of N surfels beside itself."""

    fitted: NDArray[np.int32]  # [N] epoch of the last fit, -1 before any
    changed: NDArray[np.int32]  # [N] epoch in which it last moved by more than the tolerance
    heights: NDArray[np.float32]  # [N] its height over the voxel's middle then, voxels


@dataclass(frozen=True)
class SurfelTask:
    """What an update of surfels is to do."""

    epoch: int  # number of the epoch that they are for
    trained: int  # epoch since which the field has not been trained
    most: int | None  # surfels that are fitted again at most, new ones apart; None: all
    tolerance: float  # a surfel that moves by more has changed, voxels


class SurfelMap:
    """Immutable: epochs share it."""

    def __init__(self, evidence: Evidence, surfels: Surfels, states: _States) -> None:
        """Use :func:`first_surfels` or :meth:`updated`."""
        self._surfels = surfels
        self._states = states
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

    @property
    def normals(self) -> NDArray[np.float32]:
        """Unit normals [S, 3] of the surfels, to free space."""
        return self._surfels.normals

    @property
    def kinds(self) -> NDArray[np.uint8]:
        """:class:`SurfelKind` [S] of the surfels."""
        return self._surfels.kinds

    @property
    def changed(self) -> NDArray[np.int32]:
        """Epoch [S] in which each surfel last moved noticeably, or appeared."""
        return self._states.changed

    def voxels(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """The voxels [S, 3] of the surfels; ``cells`` are those of the evidence."""
        return np.asarray(surfel_voxels(cells, self._surface, len(self)))

    def find_nearest(self, points: NDArray[np.float64], found: Nearest) -> None:
        """Improve ``found`` where a surfel lies nearer to leaf coordinates ``points`` [N, 3]."""
        find_nearest(points, self._index, found)

    def updated(self, evidence: Evidence, field: SampleField, task: SurfelTask) -> "SurfelMap":
        """The surfels of a later epoch: new ones are fitted, and of the others the oldest."""
        total = int(surfel_starts(evidence.surface)[-1])
        rows = moved_rows(self._surface, self._index.starts, evidence.surface, total)
        new = rows < 0
        surfels, states = _carried(self._surfels, self._states, rows)
        stale = np.flatnonzero(~new & (states.fitted < task.trained))
        if task.most is not None and len(stale) > task.most:
            oldest = np.argpartition(states.fitted[stale], task.most)[: task.most]
            stale = stale[oldest]
        _fit(np.concatenate([np.flatnonzero(new), stale]), surfels, states, evidence, field, task)
        return SurfelMap(evidence, surfels, states)


def first_surfels(evidence: Evidence, field: SampleField, task: SurfelTask) -> SurfelMap:
    """The surfels of all seen voxels."""
    none = SurfelMap(Evidence(1), *_empty(0))
    return none.updated(evidence, field, task)


def _empty(count: int) -> tuple[Surfels, _States]:
    return (
        Surfels(
            np.zeros((count, 3), np.float32),
            np.zeros((count, 3), np.float32),
            np.zeros(count, np.uint8),
        ),
        _States(
            np.full(count, -1, np.int32),
            np.full(count, -1, np.int32),
            np.zeros(count, np.float32),
        ),
    )


def _carried(surfels: Surfels, states: _States, rows: NDArray[np.int32]) -> tuple[Surfels, _States]:
    """What ``rows`` [N] had before; nothing where they are negative."""
    new_surfels, new_states = _empty(len(rows))
    known = rows >= 0
    old = rows[known]
    for new_record, record in ((new_surfels, surfels), (new_states, states)):
        for name, array in vars(new_record).items():
            array[known] = getattr(record, name)[old]
    return new_surfels, new_states


def _fit(
    rows: NDArray[np.int64],
    surfels: Surfels,
    states: _States,
    evidence: Evidence,
    field: SampleField,
    task: SurfelTask,
) -> None:
    """Fit some surfels, in place."""
    if not len(rows):
        return
    voxels = surfel_voxels(evidence.cells, evidence.surface, len(surfels.kinds))[rows]
    fitted = fit_surfels(voxels, field, evidence.ended_in)
    heights = (fitted.offsets * fitted.normals).sum(axis=1)
    moved = (
        (states.fitted[rows] < 0)
        | (surfels.kinds[rows] != fitted.kinds)
        | (np.abs(heights - states.heights[rows]) > task.tolerance)
    )
    surfels.offsets[rows] = fitted.offsets
    surfels.normals[rows] = fitted.normals
    surfels.kinds[rows] = fitted.kinds
    states.fitted[rows] = task.epoch
    states.changed[rows[moved]] = task.epoch
    states.heights[rows[moved]] = heights[moved]
