"""Bounded memory of training samples, spread over the map.

While there is room, all samples stay. Then each new one pushes out the more crowded of two
candidates, so that places seen long ago keep theirs and places seen for long do not take over.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

_BIN_M = 0.8
_BINS = 1 << 18
_PRIMES = (73856093, 19349663, 83492791)


@dataclass(frozen=True)
class Batch:
    """Samples to train on."""

    points: Tensor  # [B, 3] metres from the region's centre
    labels: Tensor  # [B] metres


class ReplayPool:
    """Samples of one region; the newest can be drawn apart from the others."""

    def __init__(self, capacity: int, device: torch.device, seed: int) -> None:
        self._capacity = capacity
        self._size = 0
        self._generator = torch.Generator(device).manual_seed(seed)
        self._points = torch.zeros((0, 3), device=device)
        self._labels = torch.zeros(0, device=device)
        self._bins = torch.zeros(0, dtype=torch.int32, device=device)
        self._crowd = torch.zeros(_BINS, dtype=torch.int32, device=device)
        self._fresh = torch.zeros(0, dtype=torch.int64, device=device)

    def __len__(self) -> int:
        return self._size

    def add(self, points: Tensor, labels: Tensor) -> None:
        """Take in samples: ``points`` [S, 3], ``labels`` [S]; they become the newest."""
        if len(points) > self._capacity:
            chosen = self._random(len(points), self._capacity)
            points, labels = points[chosen], labels[chosen]
        room = min(len(points), self._capacity - self._size)
        places = torch.arange(self._size, self._size + room, device=points.device)
        if room < len(points):
            places = torch.cat([places, self._crowded(len(points) - room)])
            points, labels = points[: len(places)], labels[: len(places)]
        self._extend(self._size + room)
        replaced = places[room:]
        self._crowd.index_add_(
            0, self._bins[replaced], torch.full_like(replaced, -1, dtype=torch.int32)
        )
        self._points[places] = points
        self._labels[places] = labels
        self._bins[places] = _bin(points)
        self._crowd.index_add_(0, self._bins[places], torch.ones_like(places, dtype=torch.int32))
        self._fresh = places

    def draw(self, count: int, fresh: int) -> Batch:
        """``count`` samples at random, the first ``fresh`` of them from the newest."""
        places = self._random(self._size, count)
        if fresh and len(self._fresh):
            places[:fresh] = self._fresh[self._random(len(self._fresh), fresh)]
        return Batch(self._points[places], self._labels[places])

    def limit(self, capacity: int) -> None:
        """Change the capacity; what is too much goes at random."""
        self._capacity = capacity
        if self._size > capacity:
            order = torch.randperm(
                self._size, generator=self._generator, device=self._points.device
            )
            self._keep(order[:capacity])

    def forget(self, low: Tensor, high: Tensor) -> None:
        """Drop the samples between the corners ``low`` and ``high`` [3]."""
        points = self._points[: self._size]
        inside = ((points >= low) & (points <= high)).all(dim=1)
        self._keep((~inside).nonzero()[:, 0])

    def sample(self, count: int) -> Batch:
        """At most ``count`` samples, without repetition: what a checkpoint keeps."""
        order = torch.randperm(self._size, generator=self._generator, device=self._points.device)
        return Batch(self._points[order[:count]], self._labels[order[:count]])

    def _keep(self, places: Tensor) -> None:
        self._points = self._points[places]
        self._labels = self._labels[places]
        self._bins = self._bins[places]
        self._crowd.zero_().index_add_(0, self._bins, torch.ones_like(self._bins))
        self._size = len(places)
        self._fresh = self._fresh[:0]

    def _extend(self, size: int) -> None:
        if size > len(self._points):
            room = min(self._capacity, max(size, 2 * len(self._points))) - len(self._points)
            self._points = torch.cat([self._points, self._points.new_zeros((room, 3))])
            self._labels = torch.cat([self._labels, self._labels.new_zeros(room)])
            self._bins = torch.cat([self._bins, self._bins.new_zeros(room)])
        self._size = size

    def _crowded(self, count: int) -> Tensor:
        """Up to ``count`` different places whose samples are the best to push out.

        The pool is paired up at random, each place once, and the more crowded of a pair goes.
        """
        half = self._size // 2
        count = min(count, half)
        if count == 0:
            return self._fresh[:0]
        first, offset = self._random(half, 2).tolist()
        places = torch.arange(count, device=self._points.device)
        left = (first + places * _coprime(half)) % half
        right = half + (left + offset) % half
        crowded = self._crowd[self._bins[left]] > self._crowd[self._bins[right]]
        return torch.where(crowded, left, right)

    def _random(self, below: int, count: int) -> Tensor:
        return torch.randint(
            below,
            (count,),
            generator=self._generator,
            device=self._points.device,
        )


def _coprime(size: int) -> int:
    """A stride of about a golden section of ``size`` that visits every place once."""
    stride = max(1, round(0.618 * size))
    while math.gcd(stride, size) != 1:
        stride += 1
    return stride


def _bin(points: Tensor) -> Tensor:
    cells = (points / _BIN_M).floor().to(torch.int64)
    mixed: Tensor = cells[:, 0] * _PRIMES[0] ^ cells[:, 1] * _PRIMES[1] ^ cells[:, 2] * _PRIMES[2]
    return (mixed % _BINS).to(torch.int32)
