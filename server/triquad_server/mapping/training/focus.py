"""Decides where a region learns: everywhere, or only where it was seen since all had settled."""

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_map.compiled.voxel_index import cells_of, keys_of
from triquad_map.evidence.live_evidence import LiveEvidence

from triquad_server.engine.live_field import LiveField
from triquad_server.mapping.replay.replay_pool import ReplayPool

_APPLIED_AFTER = 1 << 19
"""The samples, half a second of training, after which new blocks are taken into account: finding
their rays and rows is expensive."""

_MOST_SHARE = 0.25
"""If a larger share of the blocks with surface was seen since, all of the region learns."""

_LEAST_FREE = 0.25
"""All of the region also learns if a smaller share of the rows under what was seen since is under
nothing else: in a small place, nearly all rows are shared, and so are those under a small thing."""

_LEARNT_STEPS = 300
"""An MLP that took fewer steps has not learnt enough to stay fixed; a pretrained one has."""


class Focus:
    """Limits training to the blocks of a region that were seen since all of it had settled.

    The region learns there alone: on rays that end there, in rows of features that no surface
    elsewhere uses, and with the MLP that it has. Everything else stays as it is, to the bit. Once
    much is seen, be it scan by scan, or where there are few such rows, all of the region
    learns, with an MLP that suits all of it.
    """

    def __init__(self, field: LiveField, evidence: LiveEvidence, pool: ReplayPool) -> None:
        """Begin with all of the region learning."""
        self._field = field
        self._evidence = evidence
        self._pool = pool
        self._seen_since: Longs | None = None  # keys [B] of blocks; None: all learns
        self._blocks_applied = 0  # blocks that the field and the pool know of
        self._samples_since = 0  # samples that were trained on since

    def narrow(self) -> None:
        """From now on, train only what is seen later, since nothing is left to learn."""
        has_features = self._field.settings.encoding != "fourier"
        has_learnt = self._field.mlp_steps >= _LEARNT_STEPS
        if self._seen_since is None and has_features and has_learnt:
            self._seen_since = np.zeros(0, np.int64)
        self._blocks_applied = 0

    def widen_to(self, positions: Doubles | Longs) -> None:
        """Add blocks seen at ``positions`` [N, 3], in voxels; those outside do not count."""
        if self._seen_since is not None:
            side = 1 << self._field.settings.depth
            is_inside = ((positions >= 0) & (positions < side)).all(axis=1)
            blocks = (positions[is_inside] // BLOCK_VOXELS).astype(np.int64)
            self._seen_since = np.union1d(self._seen_since, keys_of(blocks))

    def release(self) -> None:
        """Let all of the region learn."""
        self._seen_since = None
        self._field.fix(None)
        self._pool.focus(None)

    def apply(self, samples: int) -> None:
        """Restrict the field and the pool to what was seen since, for the next ``samples``."""
        if self._seen_since is None:
            return
        self._samples_since += samples
        is_due = self._samples_since >= _APPLIED_AFTER or self._blocks_applied == 0
        if is_due and len(self._seen_since) > self._blocks_applied:
            self._blocks_applied, self._samples_since = len(self._seen_since), 0
            self._keep_to(self._seen_since)

    def _keep_to(self, seen_since: Longs) -> None:
        surface = self._evidence.surface_blocks()
        elsewhere = surface[~np.isin(keys_of(surface), seen_since)]
        if len(elsewhere) <= (1 - _MOST_SHARE) * len(surface):
            self.release()
            return
        seen = cells_of(seen_since)
        fixed = self._field.tree.rows_under(elsewhere, BLOCK_VOXELS)
        learning = self._field.tree.rows_under(seen, BLOCK_VOXELS)
        if (learning & ~fixed).sum() < _LEAST_FREE * learning.sum():
            self.release()
            return
        self._field.fix(fixed)
        self._pool.focus(seen)
