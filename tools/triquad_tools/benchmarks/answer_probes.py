"""Where a map of an exact street is asked, and the truth there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.region import MapRecord

from triquad_tools.evaluation.map_scores import DrivenStreet
from triquad_tools.mapfiles.seen_space import surface_voxels

_ALONG_RAYS = 200_000
_SHORT_OF_HIT_M = 0.3
_CORRIDOR = 100_000
_CORRIDOR_RADIUS_M = 0.5
_NEVER_SEEN = 50_000
_DEEP_M = (0.5, 3.0)  # below the ground
_GHOSTS = 50_000
_GHOST_CLEAR_M = 0.5  # from all that was seen


@dataclass(frozen=True)
class AnswerProbes:
    """Points [N, 3], metres."""

    seen_free: NDArray[np.float64]  # on rays, short of where they ended
    corridor: NDArray[np.float64]  # around the sensor's way, clear of all surfaces
    never_seen: NDArray[np.float64]  # inside houses and under the ground
    ghosts: NDArray[np.float64]  # unseen, but all three projections are of seen surface


def answer_probes(
    street: DrivenStreet, record: MapRecord, rng: np.random.Generator
) -> AnswerProbes:
    """Probes of a street, and ghosts of the map that was made of it."""
    return AnswerProbes(
        _along_rays(street, rng),
        _corridor(street, rng),
        _never_seen(street, rng),
        _ghosts(street, record, rng),
    )


def _along_rays(street: DrivenStreet, rng: np.random.Generator) -> NDArray[np.float64]:
    each = _ALONG_RAYS // len(street.scans)
    points = []
    for scan in street.scans:
        ends = scan.true_hits[rng.integers(len(scan.true_hits), size=each)]
        origin = scan.world_from_sensor[:3, 3]
        lengths = np.linalg.norm(ends - origin, axis=1)
        at = rng.uniform(0.0, np.maximum(lengths - _SHORT_OF_HIT_M, 0.0)) / lengths
        points.append(origin + at[:, None] * (ends - origin))
    return np.concatenate(points)


def _corridor(street: DrivenStreet, rng: np.random.Generator) -> NDArray[np.float64]:
    way = street.drive.poses[:, :3, 3]
    part = rng.integers(len(way) - 1, size=2 * _CORRIDOR)
    share = rng.uniform(size=(2 * _CORRIDOR, 1))
    offsets = rng.normal(size=(2 * _CORRIDOR, 3))
    offsets *= _CORRIDOR_RADIUS_M * rng.uniform(size=(len(offsets), 1)) ** (1 / 3)
    offsets /= np.linalg.norm(rng.normal(size=offsets.shape), axis=1, keepdims=True)
    points = way[part] * (1 - share) + way[part + 1] * share + offsets
    near = np.linalg.norm(offsets, axis=1) <= _CORRIDOR_RADIUS_M
    clear = street.drive.scene.sdf(points) > _CORRIDOR_RADIUS_M
    return np.asarray(points[near & clear][:_CORRIDOR])


def _never_seen(street: DrivenStreet, rng: np.random.Generator) -> NDArray[np.float64]:
    hits = street.drive.true_hits(1.0)
    low, high = hits.min(axis=0), hits.max(axis=0)
    under = rng.uniform(low, high, (4 * _NEVER_SEEN, 3))
    under[:, 2] = rng.uniform(low[2] - _DEEP_M[1], low[2] - _DEEP_M[0], len(under))
    deep = street.drive.scene.sdf(under) < -_DEEP_M[0]
    return np.concatenate([street.probes.in_houses, under[deep][:_NEVER_SEEN]])


def _ghosts(
    street: DrivenStreet, record: MapRecord, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Places that three planes of features cannot tell from seen surface."""
    voxels = surface_voxels(record)
    leaf_m = record.settings.leaf_m
    cells = np.floor(voxels / leaf_m).astype(np.int64)
    pairs = [{tuple(cell) for cell in cells[:, axes].tolist()} for axes in ([0, 2], [1, 2])]
    # Columns of one voxel at the heights of another.
    columns = cells[rng.integers(len(cells), size=40 * _GHOSTS), :2]
    heights = cells[rng.integers(len(cells), size=40 * _GHOSTS), 2]
    made = np.unique(np.column_stack([columns, heights]), axis=0)
    aliased = np.array(
        [(x, z) in pairs[0] and (y, z) in pairs[1] for x, y, z in made.tolist()], np.bool_
    )
    points = (made[aliased] + 0.5) * leaf_m
    hidden = street.drive.scene.sdf(points) < -_GHOST_CLEAR_M
    ghosts = points[hidden]
    return np.asarray(ghosts[rng.permutation(len(ghosts))[:_GHOSTS]])
