"""Records where surface appeared and vanished, epoch by epoch, and tells it as boxes."""

import threading
from collections import deque
from dataclasses import dataclass
from itertools import takewhile
from typing import NamedTuple

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

from triquad_server.epochs.epoch import Epoch, FrozenRegion
from triquad_server.epochs.history import EpochHistory

MAX_BOXES = 256
"""The most boxes of one reply. Where there would be more, voxels twice as far apart share one, and
boxes may be twice as long, and so on."""

_DECIMALS = 6  # of metres: further digits of a product mean nothing
_LONGEST_VOXELS = 32  # 6.4 m with the default leaf


@dataclass(frozen=True)
class VoxelChanges:
    """The voxels in which surface appeared or vanished."""

    voxels: Longs  # [N, 3] of the map's lattice: a voxel ``v`` reaches from v to v + 1 leaves
    appeared: Bools  # [N] else it vanished
    epochs: Longs  # [N] of the newest change of each

    def part(self, chosen: Bools) -> "VoxelChanges":
        """Return the voxels that are ``chosen`` [N]."""
        return VoxelChanges(self.voxels[chosen], self.appeared[chosen], self.epochs[chosen])


@dataclass(frozen=True)
class _EpochChanges:
    """The changes of one epoch from the one before."""

    epoch: int
    voxels: Ints  # [N, 3]
    appeared: Bools  # [N]


class _Surface(NamedTuple):
    """The surface of a region as rays have shown it."""

    keys: Longs  # [B] of the blocks
    masks: Bytes  # [B, BLOCK_BYTES]


class _Flips(NamedTuple):
    """The differences between the surface of a region and an earlier one."""

    keys: Longs  # [B] of blocks
    appeared: Bytes  # [B, BLOCK_BYTES]
    vanished: Bytes  # [B, BLOCK_BYTES]


_NO_SURFACE = _Surface(np.zeros(0, np.int64), np.zeros((0, BLOCK_BYTES), np.uint8))
CHANGES_KEPT = 1_000_000
"""The number of changes of voxels' surface that are kept, for clients that request them: 13 bytes
each."""

_NO_VOXELS = np.zeros((0, 3), np.int32)


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
        self._changes: deque[_EpochChanges] = deque()  # oldest first, none of them empty
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
                self._oldest = forgotten.epoch

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
        newest_first = reversed([changes for changes in kept if changes.epoch <= until])
        return _net(list(takewhile(lambda changes: changes.epoch > since, newest_first)))


def _net(changes: list[_EpochChanges]) -> VoxelChanges:
    """Return the net changes, given the newest first: a voxel's alternate, so pairs cancel."""
    voxels = np.concatenate([_NO_VOXELS, *(one.voxels for one in changes)]).astype(np.int64)
    appeared = np.concatenate([np.zeros(0, np.bool_), *(one.appeared for one in changes)])
    numbers = np.array([one.epoch for one in changes], np.int64)
    epochs = np.repeat(numbers, np.array([len(one.voxels) for one in changes], np.int64))
    first, number = same_cells(voxels)
    balance = np.bincount(number, np.where(appeared, 1, -1), minlength=len(first))
    rows = first[balance != 0]
    return VoxelChanges(voxels[rows], appeared[rows], epochs[rows])


def _changes(before: Epoch, now: Epoch) -> _EpochChanges:
    """Return how ``now`` differs from ``before``."""
    old = {region.index: region for region in before.frozen_regions}
    new = {region.index: region for region in now.frozen_regions}
    voxels, appeared = [_NO_VOXELS], [np.zeros(0, np.bool_)]
    for index in old | new:
        one, other = old.get(index), new.get(index)
        if one and other and one.evidence is other.evidence:
            continue
        flips = _flips(_surface_of(one), _surface_of(other))
        for masks, is_new in ((flips.appeared, True), (flips.vanished, False)):
            if masks.any():
                found = _map_voxels(index, flips.keys, masks, settings=now.field_settings)
                voxels.append(found)
                appeared.append(np.full(len(found), is_new))
    return _EpochChanges(now.number, np.concatenate(voxels), np.concatenate(appeared))


def _surface_of(region: FrozenRegion | None) -> _Surface:
    if region is None:
        return _NO_SURFACE
    seen = region.evidence.seen
    return _Surface(seen.blocks.row_keys, seen.surface)


def _flips(old: _Surface, new: _Surface) -> _Flips:
    """Return the differences. As a rule the blocks of ``new`` are those of ``old`` and more."""
    shared = min(len(old.keys), len(new.keys))
    if not np.array_equal(old.keys[:shared], new.keys[:shared]):
        shared = 0  # the region was forgotten and learnt again: all vanished, and all appeared
    rows = _differing_rows(old.masks[:shared], new.masks[:shared])
    gone, added = old.masks[shared:], new.masks[shared:]
    before = np.concatenate([old.masks[rows], gone, np.zeros_like(added)])
    now = np.concatenate([new.masks[rows], np.zeros_like(gone), added])
    keys = np.concatenate([old.keys[rows], old.keys[shared:], new.keys[shared:]])
    return _Flips(keys, now & ~before, before & ~now)


def _differing_rows(one: Bytes, other: Bytes) -> NDArray[np.intp]:
    """Return the blocks whose masks [B, BLOCK_BYTES] differ; few do."""
    words = np.flatnonzero(one.reshape(-1).view(np.uint64) != other.reshape(-1).view(np.uint64))
    return np.unique(words // (BLOCK_BYTES // np.dtype(np.uint64).itemsize))


def _map_voxels(index: RegionIndex, keys: Longs, masks: Bytes, settings: FieldSettings) -> Ints:
    """Return the voxels [N, 3] of the map's lattice set in ``masks``, without those of neighbours.

    Neighbouring regions overlap, and agree there.
    """
    used = np.flatnonzero(masks.any(axis=1))
    cells, mine = cells_of(keys[used]), settings.owned_blocks
    owned = ((cells >= mine.start) & (cells < mine.stop)).all(axis=1)
    bits = np.unpackbits(masks[used[owned]], bitorder="little").view(np.bool_)
    block, *inner = np.unravel_index(np.flatnonzero(bits), (len(used), *[BLOCK_VOXELS] * 3))
    corner = np.rint(settings.region_corner(index) / settings.leaf_m).astype(np.int64)
    corners = (corner + cells[owned] * BLOCK_VOXELS).astype(np.int32)
    return corners[block] + np.stack(inner, axis=1, dtype=np.int32, casting="unsafe")


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
