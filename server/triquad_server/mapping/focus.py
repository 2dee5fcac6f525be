"""Where a region learns: everywhere, or only where it is seen anew since all of it had settled."""

import numpy as np
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_map.compiled.evidence.live_evidence import LiveEvidence
from triquad_map.compiled.voxel_index import cells_of, keys_of

from triquad_server.engine.live_field import LiveField
from triquad_server.mapping.replay_pool import ReplayPool

_GROWTH = 1.1
"""By which what is seen anew grows before it counts: to find its rays and rows takes a while."""

_MOST_SHARE = 0.25
"""Where more of the blocks with surface are seen anew, all of the region learns."""


class Focus:
    """What of a region is seen anew since all of it had settled.

    It learns there alone: on rays that end there, in rows of features that no surface elsewhere
    uses, and with the MLP that it has. Everything else stays as it is, to the bit. Once much is
    seen anew, be it scan by scan, all of the region learns, with an MLP that suits all of it.
    """

    def __init__(self, field: LiveField, evidence: LiveEvidence, pool: ReplayPool) -> None:
        """All of the region learns."""
        self._field = field
        self._evidence = evidence
        self._pool = pool
        self._seen_anew: Longs | None = None  # keys [B] of blocks; None: all learns
        self._applied = 0  # of them, those that were known when it was applied last

    def narrow(self) -> None:
        """The region has settled: where all of it learnt, only what is seen anew does from now."""
        has_features = self._field.settings.encoding != "fourier"
        if self._seen_anew is None and has_features:
            self._seen_anew, self._applied = np.zeros(0, np.int64), 0

    def widen_to(self, voxels: Doubles) -> None:
        """``voxels`` [N, 3] are seen anew."""
        if self._seen_anew is not None:
            seen = keys_of(np.floor(voxels / BLOCK_VOXELS).astype(np.int64))
            self._seen_anew = np.union1d(self._seen_anew, seen)

    def release(self) -> None:
        """All of the region learns."""
        self._seen_anew = None
        self._field.hold(None)
        self._pool.focus(None)

    def apply(self) -> None:
        """Have the field and the pool keep to what is seen anew, where that has grown by much."""
        if self._seen_anew is None or len(self._seen_anew) <= _GROWTH * self._applied:
            return
        self._applied = len(self._seen_anew)
        surface = self._evidence.surface_blocks()
        elsewhere = surface[~np.isin(keys_of(surface), self._seen_anew)]
        if len(elsewhere) < (1 - _MOST_SHARE) * len(surface):
            self.release()
            return
        self._field.hold(self._field.tree.rows_under(elsewhere, BLOCK_VOXELS))
        self._pool.focus(cells_of(self._seen_anew))
