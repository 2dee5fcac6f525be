"""Scores of a map of an exact street, which answers as a file or a server does.

Asked are points near surface that the lidar truly hit: the hits, one per 10 cm voxel, moved along
the exact normal by a random -10 to +10 cm, wherever the exact distance is known. The truth is the
exact signed distance there, not the offset. Points deeper than 0.5 m in houses, where no ray can
have been, have to be ``UNKNOWN``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_client import SdfResult
from triquad_format.records.arrays import Doubles
from triquad_format.records.status import Status
from triquad_map.view import FieldAnswer
from triquad_tools.evaluation.metrics import mean_or_nan
from triquad_tools.simulation.lidar import SimulatedDrive
from triquad_tools.simulation.scene import Scene

from bench.driven import Driven, driven

NEAR_M = 0.1  # distances are scored up to this far from the surface
HOUSE_MARGIN_M = 0.5  # deeper than this in a house nothing can be seen
_PROBE_SPACING_M = 0.1  # between surface points at which distances are scored
_VOXEL_M = 0.05  # between the points of a street that completion asks for
_HOUSE_PROBES = 20_000
_SEED = 0  # of the points at which a driven street is asked
_HOUSE_REACH_M = 20.0  # houses are probed up to this far from where the sensor was


MapQuery = Callable[..., SdfResult | FieldAnswer]
"""Asks a map at points ``[N, 3]``, metres, map frame; with ``gradient=True`` for gradients, too."""


@dataclass(frozen=True)
class StreetProbes:
    """The points at which a map of a street is asked, and the truth there."""

    near: Doubles  # [N, 3] within NEAR_M of surface that the lidar truly hit
    exact_sdf: Doubles  # [N] metres
    exact_gradient: Doubles  # [N, 3]
    in_houses: Doubles  # [M, 3] where no ray can have been


@dataclass(frozen=True)
class DrivenStreet(Driven):
    """A simulated drive along a street, and the truth about what it shows."""

    probes: StreetProbes


@dataclass(frozen=True)
class StreetScores:
    """The agreement of a map with an exact street; NaN where there was nothing to score."""

    sdf_error_m: float  # mean absolute error near the surface
    gradient_angle_deg: float  # median angle to the exact gradient
    houses_unknown_ratio: float  # share of the points in houses with status UNKNOWN


def street_probes(drive: SimulatedDrive, rng: np.random.Generator) -> StreetProbes:
    """Return points at which a map of ``drive`` is scored."""
    hits = drive.true_hits(_PROBE_SPACING_M)
    normals = drive.scene.gradient(hits)
    near = hits + rng.uniform(-NEAR_M, NEAR_M, (len(hits), 1)) * normals
    near = near[drive.scene.is_exact(near)]
    return StreetProbes(
        near=near,
        exact_sdf=drive.scene.sdf(near),
        exact_gradient=drive.scene.gradient(near),
        in_houses=_points_in_houses(drive.scene, drive.poses[:, :3, 3], rng),
    )


def driven_street(drive: SimulatedDrive) -> DrivenStreet:
    """Make all scans of a drive."""
    probes = street_probes(drive, np.random.default_rng(_SEED))
    return DrivenStreet(**vars(driven(drive, _VOXEL_M)), probes=probes)


def score_street(query: MapQuery, probes: StreetProbes) -> StreetScores:
    """Return scores of a map at ``probes``."""
    answer = query(probes.near, gradient=True)
    known = np.isfinite(answer.sdf)
    errors = np.abs(answer.sdf.astype(np.float64) - probes.exact_sdf)[known]
    houses = query(probes.in_houses)
    return StreetScores(
        sdf_error_m=mean_or_nan(errors),
        gradient_angle_deg=_median_angle_deg(answer.gradient[known], probes.exact_gradient[known]),
        houses_unknown_ratio=mean_or_nan(houses.status == Status.UNKNOWN),
    )


def _points_in_houses(scene: Scene, positions: Doubles, rng: np.random.Generator) -> Doubles:
    """Return uniform points ``[M, 3]`` above ground in houses near the sensor's ``positions``."""
    low = np.maximum(scene.bounds[0], positions.min(axis=0) - _HOUSE_REACH_M)
    high = np.minimum(scene.bounds[1], positions.max(axis=0) + _HOUSE_REACH_M)
    low[2] = max(low[2], 0.0)
    drawn = rng.uniform(low, high, (_HOUSE_PROBES * 5, 3))
    return drawn[scene.is_inside_house(drawn, HOUSE_MARGIN_M)][:_HOUSE_PROBES]


def _median_angle_deg(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Return the median of the angles between vectors ``[N, 3]``; NaN where there are none."""
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    cosines = np.einsum("ni,ni->n", one, other) / np.maximum(lengths, 1e-12)
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return float(np.median(angles)) if len(angles) else float("nan")
