"""Bounded memory of what rays have taught, spread over the map.

While there is room, all segments stay. Then each new one pushes out the more crowded of two
candidates, so that places seen long ago keep theirs and places seen for long do not take over.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_map.compiled.field.feature_rows import prefetch_row
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.sparse.rows import with_room

from triquad_server.mapping.ray_labels import COLUMNS, END
from triquad_server.mapping.sampling import Batch, Placement, draw_ordered_samples, draw_samples

_BIN_M = 0.8
_BINS = 1 << 18
_AHEAD = 16  # places that are brought into the cache before their turn

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Places = NDArray[np.int64]


@kernel()
def _bin(segment: Floats) -> int:
    mixed: int = np.int64(0)
    for axis, prime in enumerate((73856093, 19349663, 83492791)):
        mixed ^= int(np.floor(segment[END + axis] / _BIN_M)) * prime
    return mixed & (_BINS - 1)


@kernel()
def _crowded(
    size: int, count: int, first: int, stride: int, offset: int, bins: Ints, crowd: Ints
) -> Places:
    """Different places whose segments are the best to push out, ``count <= size // 2`` of them.

    The pool is paired up, each place once, and the more crowded of a pair goes.
    """
    half = size // 2
    chosen = np.empty(count, np.int64)
    for i in range(count):
        left = (first + i * stride) % half
        right = half + (left + offset) % half
        chosen[i] = left if crowd[bins[left]] > crowd[bins[right]] else right
    return chosen


@kernel()
def _put(new: Floats, places: Places, used: int, segments: Floats, bins: Ints, crowd: Ints) -> None:
    """Put new segments into places; those below ``used`` hold one that is pushed out."""
    for i in range(len(places)):
        prefetch_row(segments, places[min(i + _AHEAD, len(places) - 1)])
        place = places[i]
        if place < used:
            crowd[bins[place]] -= 1
        segments[place] = new[i]
        bins[place] = _bin(new[i])
        crowd[bins[place]] += 1


class ReplayPool:
    """Segments of one region; the newest can be drawn from apart from the others."""

    def __init__(
        self, capacity: int, placement: Placement, device: torch.device, seed: int
    ) -> None:
        self._capacity = capacity
        self._placement = placement
        self._device = device
        self._size = 0
        self.offered = 0  # segments so far, those included that were not kept
        self._rng = np.random.default_rng(seed)
        self._generator = torch.Generator(device).manual_seed(seed)
        self._segments = np.zeros((0, COLUMNS), np.float32)
        # Of the segments, and of the newest places, where training is not done here.
        self._twin: Tensor | None = None
        self._fresh_twin = torch.zeros(0, dtype=torch.int64, device=device)
        self._bins = np.zeros(0, np.int32)
        self._crowd = np.zeros(_BINS, np.int32)
        self._fresh = np.zeros(0, np.int64)

    def __len__(self) -> int:
        return self._size

    def add(self, segments: Floats) -> None:
        """Take in ``segments`` [S, COLUMNS]; they become the newest."""
        self.offered += len(segments)
        used = self._size
        room = min(len(segments), self._capacity - used)
        places = np.arange(used, used + room)
        if room < len(segments):
            places = np.concatenate([places, self._crowded(len(segments) - room)])
        if len(places) < len(segments):
            # Any of them: the last rays of a scan are as good as the first.
            segments = segments[self._rng.permutation(len(segments))[: len(places)]]
        self._extend(used + room)
        _put(segments, places, used, self._segments, self._bins, self._crowd)
        if self._twin is not None:
            self._fresh_twin = torch.from_numpy(places).to(self._device)
            self._twin[self._fresh_twin] = torch.from_numpy(segments).to(self._device)
        self._fresh = places

    def draw(self, count: int, fresh: int) -> Batch:
        """``count`` samples on segments at random, ``fresh`` of them on the newest."""
        if self._twin is not None:
            return draw_samples(self._choose(count, fresh), self._placement, self._generator)
        places = self._rng.integers(self._size, size=count)
        if fresh and len(self._fresh):
            places[:fresh] = self._fresh[self._rng.integers(len(self._fresh), size=fresh)]
        return draw_ordered_samples(self._segments, places, self._placement, self._rng)

    def limit(self, capacity: int) -> None:
        """Change the capacity; what is too much goes at random."""
        self._capacity = capacity
        if self._size > capacity:
            self._keep(self._rng.permutation(self._size)[:capacity])

    def forget(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Drop the segments that end between the corners ``low`` and ``high`` [3]."""
        ends = self._segments[: self._size, END : END + 3]
        self._keep(np.flatnonzero(~((ends >= low) & (ends <= high)).all(axis=1)))
        self.offered = self._size

    def sample(self, count: int) -> Batch:
        """Samples on at most ``count`` segments, one on each: what a checkpoint keeps."""
        places = self._rng.permutation(self._size)[:count]
        return draw_ordered_samples(self._segments, places, self._placement, self._rng)

    def _choose(self, count: int, fresh: int) -> Tensor:
        """Segments [count, COLUMNS] at random, on the device, without a word from here."""
        assert self._twin is not None
        places = self._random(self._size, count)
        if fresh and len(self._fresh):
            places[:fresh] = self._fresh_twin[self._random(len(self._fresh), fresh)]
        return self._twin[places]

    def _random(self, below: int, count: int) -> Tensor:
        return torch.randint(below, (count,), generator=self._generator, device=self._device)

    def _keep(self, places: Places) -> None:
        self._segments = self._segments[places]
        self._bins = self._bins[places]
        self._crowd = np.bincount(self._bins, minlength=_BINS).astype(np.int32)
        self._size = len(places)
        self._fresh = self._fresh[:0]
        self._copy_to_device()

    def _extend(self, size: int) -> None:
        if size > len(self._segments):
            room = min(self._capacity, max(size, 2 * len(self._segments)))
            self._segments = with_room(self._segments[: self._size], room)
            self._bins = with_room(self._bins[: self._size], room)
            self._copy_to_device()
        self._size = size

    def _copy_to_device(self) -> None:
        if self._device.type != "cpu":
            self._twin = torch.from_numpy(self._segments).to(self._device)

    def _crowded(self, count: int) -> Places:
        half = self._size // 2
        count = min(count, half)
        if count == 0:
            return self._fresh[:0]
        first, offset = self._rng.integers(half, size=2)
        stride = _coprime(half)
        return _crowded(self._size, count, first, stride, offset, self._bins, self._crowd)


def _coprime(size: int) -> int:
    """A stride of about a golden section of ``size`` that visits every place once."""
    stride = max(1, round(0.618 * size))
    while math.gcd(stride, size) != 1:
        stride += 1
    return stride
