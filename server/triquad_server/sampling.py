"""Training samples along rays (3QFP, section III-C)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from triquad_server.scan import Rays
from triquad_server.settings import ScanSettings

_MIN_COSINE = 0.05


@dataclass(frozen=True)
class Samples:
    """Points with signed distances."""

    points: NDArray[np.float64]  # [S, 3] metres, map frame
    labels: NDArray[np.float32]  # [S] metres, positive in front of the surface


def draw_samples(
    rays: Rays,
    normals: NDArray[np.float64],
    settings: ScanSettings,
    rng: np.random.Generator,
) -> Samples:
    """Samples near the end points of rays and in the free space before them.

    The published label is the distance to the end point along the ray, which is too large where
    the ray meets the surface at an angle. Where the surface's normal is known, the label here is
    the distance to its plane.

    Args:
        rays: N rays.
        normals: [N, 3] unit normals at the end points, NaN where unknown.
        settings: numbers of samples and their ranges.
        rng: source of the random positions.
    """
    along = rays.ends - rays.origin
    ranges = np.linalg.norm(along, axis=1)
    directions = along / ranges[:, None]
    cosines = np.abs((directions * normals).sum(axis=1))
    cosines = np.where(np.isnan(cosines), 1.0, np.maximum(cosines, _MIN_COSINE))

    count = len(ranges)
    near = rng.uniform(
        -settings.truncation_m,
        settings.truncation_m,
        (count, settings.surface_samples),
    )
    first = settings.free_from * ranges[:, None]
    last = ranges[:, None] + settings.behind_m
    free = rng.uniform(first, last, (count, settings.free_samples)) - ranges[:, None]
    offsets = np.concatenate([near, free], axis=1)  # behind the end point, along the ray

    points = rays.ends[:, None] + offsets[..., None] * directions[:, None]
    labels = -offsets * cosines[:, None]
    return Samples(points.reshape(-1, 3), labels.reshape(-1).astype(np.float32))
