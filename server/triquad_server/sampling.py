"""Training samples drawn along segments (3QFP, section III-C).

Every draw makes new ones: a segment that is trained on again teaches other points of its ray.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from triquad_server.segments import DIRECTION, END, FREE_FROM, FREE_TO, LABEL, SLOPE

Floats = NDArray[np.float32]

_CELLS = 256
"""Cells from the centre of the cube to its face, by which samples are put in order."""


class Placement(NamedTuple):
    """Where on their segments samples lie."""

    surface_share: float  # of the samples that lie around the end points
    spread_m: float  # standard deviation of those
    truncation_m: float  # and how far off they lie at most
    half_side_m: float  # of the region's cube: samples lie inside


@dataclass(frozen=True)
class Batch:
    """Samples to train on."""

    points: Tensor  # [B, 3] metres from the region's centre
    labels: Tensor  # [B] signed distances, metres


def draw_samples(segments: Tensor, placement: Placement, generator: torch.Generator) -> Batch:
    """One sample on each of the ``segments`` [B, COLUMNS], on their device."""
    kinds, places = torch.rand((2, len(segments)), generator=generator, device=segments.device)
    near = torch.randn(len(segments), generator=generator, device=segments.device)
    near = (near * placement.spread_m).clamp(-placement.truncation_m, placement.truncation_m)
    ends, directions = segments[:, END : END + 3], segments[:, DIRECTION : DIRECTION + 3]
    first, last = segments[:, FREE_FROM], segments[:, FREE_TO]
    outside = ((ends + near[:, None] * directions).abs() >= placement.half_side_m).any(dim=1)
    free = first + places * (last - first)
    offsets = torch.where((kinds < placement.surface_share) & ~outside, near, free)
    return Batch(
        ends + offsets[:, None] * directions,
        segments[:, LABEL] - offsets * segments[:, SLOPE],
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _every_third_bit(number: int) -> int:
    """The 10 bits of a number, each followed by two zeros."""
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
        number = (number | (number << shift)) & mask
    return number


@numba.njit(cache=True, nogil=True)
def _draw(
    segments: Floats,
    chosen: NDArray[np.int64],
    placement: Placement,
    kinds: Floats,
    places: Floats,
    near: Floats,
    samples: Floats,
    cells: NDArray[np.int64],
) -> None:
    cell_m = placement.half_side_m / _CELLS
    for i in range(len(chosen)):
        row = segments[chosen[i]]
        offset = near[i] * placement.spread_m
        offset = min(max(offset, -placement.truncation_m), placement.truncation_m)
        outside = False
        for axis in range(3):
            place = row[END + axis] + offset * row[DIRECTION + axis]
            outside = outside or abs(place) >= placement.half_side_m
        if outside or kinds[i] >= placement.surface_share:
            offset = row[FREE_FROM] + places[i] * (row[FREE_TO] - row[FREE_FROM])
        cell = np.int64(0)
        for axis in range(3):
            place = row[END + axis] + offset * row[DIRECTION + axis]
            samples[i, axis] = place
            cell |= _every_third_bit(int(place / cell_m) + _CELLS) << axis
        samples[i, 3] = row[LABEL] - offset * row[SLOPE]
        cells[i] = cell


def draw_ordered_samples(
    segments: Floats,
    chosen: NDArray[np.int64],
    placement: Placement,
    rng: np.random.Generator,
) -> Batch:
    """As :func:`draw_samples` for the segments ``chosen`` [B], in compiled code.

    Neighbours in space follow each other, and find in the cache what the last one fetched.
    """
    count = len(chosen)
    samples = np.empty((count, 4), np.float32)
    cells = np.empty(count, np.int64)
    kinds, places = rng.random((2, count), np.float32)
    near = rng.standard_normal(count, np.float32)
    _draw(segments, chosen, placement, kinds, places, near, samples, cells)
    samples = samples[np.argsort(cells)]
    return Batch(
        torch.from_numpy(np.ascontiguousarray(samples[:, :3])),
        torch.from_numpy(np.ascontiguousarray(samples[:, 3])),
    )
