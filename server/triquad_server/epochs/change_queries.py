"""Answers queries of where surface appeared and vanished."""

from dataclasses import dataclass

import numpy as np
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Bools, Bytes, Longs
from triquad_format.wire.query_messages import ChangesReply, ChangesRequest
from triquad_map.clusters import Boxes, tight_boxes

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.epochs.surface_history import SurfaceHistory, VoxelChanges

MAX_BOXES = 256
"""The most boxes of one reply. Where there would be more, voxels twice as far apart share one, and
boxes may be twice as long, and so on."""

_DECIMALS = 6  # of metres: further digits of a product mean nothing
_LONGEST_VOXELS = 32  # 6.4 m with the default leaf


class ChangeQueries:
    """Answers what changed since an epoch."""

    def __init__(self, epochs: EpochHistory, history: SurfaceHistory, server: str) -> None:
        """Make the handler; ``server`` is the name that replies carry."""
        self._epochs = epochs
        self._history = history
        self._server = server

    def changes(self, request: ChangesRequest) -> ChangesReply:
        """Return what changed in the request's box.

        Raises:
            RefusedError: it is not known what changed since then.
        """
        newest = self._epochs.newest
        if request.server not in ("", self._server):
            raise RefusedError(
                "epoch_gone",
                f"epoch {request.since} is one of server {request.server[:64]!r}, and this is "
                f"{self._server!r}: it was restarted; ask for the map again, then for changes "
                f"since its epoch, {newest.number} now or later",
            )
        since = request.since or newest.number
        changes = self._history.between(since, newest.number)
        inside = _inside(changes, request, newest)
        return self._reply(_boxed(changes.part(inside)), since, newest)

    def _reply(self, kinds: "list[_Boxed]", since: int, newest: Epoch) -> ChangesReply:
        low, high = (
            np.concatenate(corners) * newest.field_settings.leaf_m
            for corners in zip(*((kind.boxes.low, kind.boxes.high) for kind in kinds), strict=True)
        )
        return ChangesReply(
            epoch=newest.number,
            server=self._server,
            since=since,
            minimum=low.round(_DECIMALS),
            maximum=high.round(_DECIMALS),
            appeared=np.concatenate([kind.appeared for kind in kinds]),
            epochs=np.concatenate([kind.epochs for kind in kinds]),
            voxels=np.concatenate([kind.counts for kind in kinds]),
        )


@dataclass(frozen=True)
class _Boxed:
    """The voxels that all appeared, or all vanished, and the boxes around them."""

    voxels: VoxelChanges
    boxes: Boxes

    @property
    def appeared(self) -> Bytes:
        """Return 1 where surface appeared, 0 where it vanished, for each box."""
        appeared = np.zeros(len(self.boxes.low), np.uint8)
        appeared[self.boxes.box] = self.voxels.appeared
        return appeared

    @property
    def epochs(self) -> Longs:
        """Return the epoch of the newest change in each box."""
        epochs = np.zeros(len(self.boxes.low), np.int64)
        np.maximum.at(epochs, self.boxes.box, self.voxels.epochs)
        return epochs

    @property
    def counts(self) -> Longs:
        """Return the number of voxels in each box."""
        return np.bincount(self.boxes.box, minlength=len(self.boxes.low)).astype(np.int64)


def _boxed(changes: VoxelChanges) -> list[_Boxed]:
    """Return boxes, few enough, around voxels that appeared, and around those that vanished."""
    kinds = [changes.part(changes.appeared), changes.part(~changes.appeared)]
    scale = 1
    while True:
        boxed = [
            _Boxed(kind, tight_boxes(kind.voxels, _LONGEST_VOXELS, scale=scale)) for kind in kinds
        ]
        if sum(len(kind.boxes.low) for kind in boxed) <= MAX_BOXES:
            return boxed
        scale *= 2


def _inside(changes: VoxelChanges, request: ChangesRequest, newest: Epoch) -> Bools:
    """Return whether the middle of each voxel [N] lies in the request's box."""
    middles = (changes.voxels + 0.5) * newest.field_settings.leaf_m
    inside = (middles >= request.minimum) & (middles <= request.maximum)
    return np.asarray(inside.all(axis=1))
