"""Records where surface appeared and vanished, epoch by epoch, and tells it as boxes."""

import logging
import threading
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import RefusedError
from triquad_format.records.arrays import Bools, Bytes, Ints, Longs
from triquad_format.records.cells import same_cells
from triquad_format.records.field_settings import BLOCK_VOXELS, FieldSettings, RegionIndex
from triquad_format.records.region import BLOCK_BYTES
from triquad_format.wire.query_messages import ChangesReply, ChangesRequest
from triquad_map.clusters import Boxes, tight_boxes
from triquad_map.compiled.voxel_index import cells_of

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.epochs.epoch import Epoch, EpochRegion, FrozenRegion

_log = logging.getLogger(__name__)

MAX_BOXES = 256
"""The most boxes of one reply. Where there would be more, voxels twice as far apart share one, and
boxes may be twice as long, and so on."""

_DECIMALS = 6  # of metres: further digits of a product mean nothing
_LONGEST_VOXELS = 32  # 6.4 m with the default leaf


@dataclass(frozen=True)
class VoxelChanges:
    """The voxels in which surface appeared or vanished."""

    voxels: Ints  # [N, 3] of the map's lattice: a voxel ``v`` reaches from v to v + 1 leaves
    appeared: Bools  # [N] else it vanished
    epochs: Longs  # [N] of the newest change of each

    def part(self, chosen: Bools | Longs) -> "VoxelChanges":
        """Return the voxels that are ``chosen``: [N] of all, or their rows."""
        return VoxelChanges(self.voxels[chosen], self.appeared[chosen], self.epochs[chosen])


@dataclass(frozen=True)
class _Surface:
    """The surface of a region as rays have shown it."""

    keys: Longs  # [B] of the blocks
    masks: Bytes  # [B, BLOCK_BYTES]

    @staticmethod
    def of(region: EpochRegion | None) -> "_Surface":
        """Return the surface of a region; none where there is no region."""
        if region is None:
            return _Surface(np.zeros(0, np.int64), np.zeros((0, BLOCK_BYTES), np.uint8))
        try:
            seen = region.read_evidence().seen
        except RefusedError as error:
            _log.error("what was seen in region %s before is not told: %s", region.index, error)
            return _Surface.of(None)
        return _Surface(seen.blocks.row_keys, seen.surface)

    def without(self, other: "_Surface") -> "_Surface":
        """Return the voxels that ``other`` does not have; one of the two is the earlier one.

        As a rule the blocks of the later one are those of the earlier one and more.
        """
        shared = min(len(self.keys), len(other.keys))
        if not np.array_equal(self.keys[:shared], other.keys[:shared]):
            shared = 0  # the region was forgotten and learnt again: all vanished, and all appeared
        rows = _differing_rows(self.masks[:shared], other.masks[:shared])
        return _Surface(
            np.concatenate([self.keys[rows], self.keys[shared:]]),
            np.concatenate([self.masks[rows] & ~other.masks[rows], self.masks[shared:]]),
        )


CHANGES_KEPT = 1_000_000
"""The number of changes of voxels' surface that are kept, for clients that request them: 21 bytes
each."""

_NO_CHANGES = VoxelChanges(np.zeros((0, 3), np.int32), np.zeros(0, np.bool_), np.zeros(0, np.int64))


class SurfaceHistory:
    """Keeps the changes of the surface from epoch to epoch; one thread adds, any may query.

    The newest changes are kept, ``limit`` voxels at most: older epochs are forgotten as a whole.
    """

    def __init__(self, first: Epoch, limit: int) -> None:
        """Begin with the epoch that is published first."""
        self._newest = first
        self._limit = limit
        self._lock = threading.Lock()
        self._oldest = first.number  # changes after it are known
        self._changes: deque[VoxelChanges] = deque()  # by epoch, the oldest first; none is empty
        self._voxels = 0  # of all changes

    def add(self, epoch: Epoch) -> None:
        """Record what ``epoch`` changes; call this before others can see it."""
        changes = _changes(self._newest, epoch)
        with self._lock:
            self._newest = epoch
            if len(changes.voxels):
                self._changes.append(changes)
                self._voxels += len(changes.voxels)
            while self._voxels > self._limit:
                forgotten = self._changes.popleft()
                self._voxels -= len(forgotten.voxels)
                self._oldest = int(forgotten.epochs[0])

    def between(self, since: int, until: int) -> VoxelChanges:
        """Return what differs between the epochs ``since`` and ``until``.

        A surface that appeared and vanished again in between is not included.

        Raises:
            RefusedError: ``epoch_gone``: changes are not known from ``since`` on.
        """
        with self._lock:
            oldest, kept = self._oldest, list(self._changes)
        if not oldest <= since <= until:
            raise RefusedError(
                "epoch_gone",
                f"changes since epoch {since} are not known: the newest epoch is {until}, and the "
                f"oldest to ask from is {oldest}; ask for the map again, then for changes since "
                f"its epoch",
            )
        return _net([one for one in reversed(kept) if since < one.epochs[0] <= until])


def _net(changes: list[VoxelChanges]) -> VoxelChanges:
    """Return the net changes, given the newest first: a voxel's alternate, so pairs cancel."""
    every = _joined(changes)
    first, number = same_cells(every.voxels.astype(np.int64))
    balance = np.bincount(number, np.where(every.appeared, 1, -1), minlength=len(first))
    return every.part(first[balance != 0])


def _joined(changes: list[VoxelChanges]) -> VoxelChanges:
    columns = zip(*(vars(one).values() for one in (_NO_CHANGES, *changes)), strict=True)
    return VoxelChanges(*map(np.concatenate, columns))


def _changes(before: Epoch, now: Epoch) -> VoxelChanges:
    """Return how ``now`` differs from ``before``."""
    old = {region.index: region for region in before.frozen_regions}
    new = {region.index: region for region in now.frozen_regions}
    found = []
    for index in old | new:
        one, other = old.get(index), new.get(index)
        if one is other or (one and isinstance(other, ColdRegion)):
            continue  # it left memory as it was
        if isinstance(other, ColdRegion) and other.is_foreign:
            continue  # the server that has it tells of it
        if isinstance(one, FrozenRegion) and other and one.evidence is other.evidence:
            continue
        was, has = _Surface.of(one), _Surface.of(other)
        for changed, is_new in ((has.without(was), True), (was.without(has), False)):
            voxels = _map_voxels(index, changed, now.field_settings)
            epochs = np.full(len(voxels), now.number)
            found.append(VoxelChanges(voxels, np.full(len(voxels), is_new), epochs))
    return _joined(found)


def _differing_rows(one: Bytes, other: Bytes) -> NDArray[np.intp]:
    """Return the blocks whose masks [B, BLOCK_BYTES] differ; few do."""
    words = np.flatnonzero(one.reshape(-1).view(np.uint64) != other.reshape(-1).view(np.uint64))
    return np.unique(words // (BLOCK_BYTES // np.dtype(np.uint64).itemsize))


def _map_voxels(index: RegionIndex, surface: _Surface, settings: FieldSettings) -> Ints:
    """Return the voxels [N, 3] of the map's lattice in a region, without those of its neighbours.

    Neighbouring regions overlap, and agree there.
    """
    used = np.flatnonzero(surface.masks.any(axis=1))
    cells, mine = cells_of(surface.keys[used]), settings.owned_blocks
    owned = ((cells >= mine.start) & (cells < mine.stop)).all(axis=1)
    bits = np.unpackbits(surface.masks[used[owned]], bitorder="little").view(np.bool_)
    block, *inner = np.unravel_index(np.flatnonzero(bits), (len(used), *[BLOCK_VOXELS] * 3))
    corner = np.rint(settings.region_corner(index) / settings.leaf_m).astype(np.int64)
    corners = (corner + cells[owned] * BLOCK_VOXELS).astype(np.int32)
    return corners[block] + np.stack(inner, axis=1, dtype=np.int32, casting="unsafe")


def changes_reply(
    request: ChangesRequest, history: SurfaceHistory, newest: Epoch, server: str
) -> ChangesReply:
    """Return what changed in the request's box until the ``newest`` epoch of this ``server``.

    Raises:
        RefusedError: it is not known what changed since then.
    """
    if request.server not in ("", server):
        raise RefusedError(
            "epoch_gone",
            f"epoch {request.since} is one of server {request.server[:64]!r}, and this is "
            f"{server!r}: it was restarted; ask for the map again, then for changes since its "
            f"epoch, {newest.number} now or later",
        )
    since = request.since or newest.number
    changes = history.between(since, newest.number)
    changes = changes.part(_inside(changes, request, newest))
    # Surface that appeared and surface that vanished share no box.
    kinds = [changes.part(changes.appeared), changes.part(~changes.appeared)]
    boxes = _boxes_around(kinds)
    leaf_m = newest.field_settings.leaf_m
    counts = [np.bincount(one.box, minlength=len(one.low)).astype(np.int64) for one in boxes]
    return ChangesReply(
        epoch=newest.number,
        server=server,
        since=since,
        minimum=(np.concatenate([one.low for one in boxes]) * leaf_m).round(_DECIMALS),
        maximum=(np.concatenate([one.high for one in boxes]) * leaf_m).round(_DECIMALS),
        appeared=np.repeat(np.array([1, 0], np.uint8), [len(one.low) for one in boxes]),
        epochs=np.concatenate([_newest_in(*of_kind) for of_kind in zip(boxes, kinds, strict=True)]),
        voxels=np.concatenate(counts),
    )


def _newest_in(boxes: Boxes, changes: VoxelChanges) -> Longs:
    """Return the epoch of the newest change in each box."""
    epochs = np.zeros(len(boxes.low), np.int64)
    np.maximum.at(epochs, boxes.box, changes.epochs)
    return epochs


def _boxes_around(kinds: list[VoxelChanges]) -> list[Boxes]:
    """Return boxes, few enough, around the voxels of each kind."""
    scale = 1
    while True:
        boxes = [
            tight_boxes(kind.voxels.astype(np.int64), _LONGEST_VOXELS, scale=scale)
            for kind in kinds
        ]
        if sum(len(one.low) for one in boxes) <= MAX_BOXES:
            return boxes
        scale *= 2


def _inside(changes: VoxelChanges, request: ChangesRequest, newest: Epoch) -> Bools:
    """Return whether the middle of each voxel [N] lies in the request's box."""
    middles = (changes.voxels + 0.5) * newest.field_settings.leaf_m
    inside = (middles >= request.minimum) & (middles <= request.maximum)
    return np.asarray(inside.all(axis=1))
