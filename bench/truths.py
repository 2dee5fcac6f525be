"""Answers: how true they are, and how well unknown space is recognised."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import spearmanr
from triquad_format.records.arrays import Bools, Doubles
from triquad_format.records.region import MapRecord, surface_voxels
from triquad_format.records.status import Status
from triquad_map.questions.bodies import spheres
from triquad_map.questions.distance import Distances, distances
from triquad_map.surface import level_confidence
from triquad_map.view import MapView
from triquad_tools.simulation.scene import Scene

from bench.figures import Figure
from bench.street_scores import DrivenStreet

REACH_M = 5.0
_NEAR_M = 0.3  # gradients are scored beyond
_BEHIND_M = 0.3  # how far behind surfaces distances are scored
_BALL_M = 0.2
_ASKED = 120_000
_LEAST_IN_BIN = 200
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

    seen_free: Doubles  # on rays, short of where they ended
    corridor: Doubles  # around the sensor's way, clear of all surfaces
    never_seen: Doubles  # inside houses and under the ground
    ghosts: Doubles  # unseen, but all three projections are of seen surface


def measure_answers(street: DrivenStreet, record: MapRecord, view: MapView) -> list[Figure]:
    """Return figures of a map of ``street``, its ``record`` and what answers from it."""
    rng = np.random.default_rng(0)
    probes = AnswerProbes(
        seen_free=_along_rays(street, rng),
        corridor=_corridor_points(street, rng),
        never_seen=_never_seen(street, rng),
        ghosts=_ghosts(street, record, rng),
    )
    return (
        _distances(street.drive.scene, probes, view, rng=rng)
        + _unknown(probes, view)
        + _corridor(probes, view)
    )


def _distances(
    scene: Scene, probes: AnswerProbes, view: MapView, rng: np.random.Generator
) -> list[Figure]:
    points = probes.seen_free[rng.permutation(len(probes.seen_free))[:_ASKED]]
    truth = scene.sdf(points)
    inside = (truth <= REACH_M) & (truth > -_BEHIND_M)
    points, truth = points[inside], truth[inside]
    slopes = scene.gradient(points)
    answer = distances(view, points, REACH_M, unknown_distance=True)
    feet_seen = view.status(points - truth[:, None] * slopes) == Status.SURFACE
    # What a planner can see from the answer itself.
    known = answer.unknown_distance_m >= answer.distance_m
    figures = [Figure("points to which a surface is nearer than unknown space",
                      100 * known.mean(), "%")]  # fmt: skip
    figures += _errors("known space", answer, truth, slopes, chosen=known, bounds=(5.0, 12.0, 0.15))
    figures += _errors("nearest surface seen", answer, truth, slopes=slopes, chosen=feet_seen)
    wary = np.minimum(answer.distance_m, answer.unknown_distance_m) - truth
    figures += [
        Figure("all, unknown as an obstacle: too large, 99.9 %", np.quantile(wary, 0.999), "m"),
        Figure("all, unknown as an obstacle: share too large by a voxel",
               100 * (wary > view.voxel_m).mean(), "%"),
        Figure("all, unknown as an obstacle: too large at most", wary.max(), "m"),
    ]  # fmt: skip
    return figures + _calibration(answer, truth, feet_seen)


def _errors(
    name: str,
    answer: Distances,
    truth: Doubles,
    slopes: Doubles,
    chosen: Bools,
    bounds: tuple[float, float, float] | None = None,
) -> list[Figure]:
    error = (answer.distance_m - truth)[chosen]
    away = chosen & (truth > _NEAR_M)
    aligned = (answer.gradient[away] * slopes[away]).sum(axis=1) >= np.cos(np.deg2rad(10.0))
    mean_cm, tail_cm, most_m = bounds or (None, None, None)
    return [
        Figure(f"{name}: distance error, mean", 100 * np.abs(error).mean(), "cm", at_most=mean_cm),
        Figure(f"{name}: distance error, 99 %", 100 * np.quantile(np.abs(error), 0.99), "cm",
               at_most=tail_cm),
        Figure(f"{name}: too large at most", error.max(), "m", at_most=most_m),
        Figure(f"{name}: too large by 0.15 m", 100 * (error > 0.15).mean(), "%"),
        Figure(f"{name}: gradient within 10 degrees, outside 0.3 m", 100 * aligned.mean(), "%",
               at_least=90.0 if bounds else None),
    ]  # fmt: skip


def _calibration(answer: Distances, truth: Doubles, chosen: Bools) -> list[Figure]:
    """Return figures of whether errors fall as the stated confidence rises."""
    chosen = chosen & answer.found
    error = np.abs(answer.distance_m - truth)[chosen]
    levels = level_confidence()
    edges = np.concatenate([[0.0], (levels[1:] + levels[:-1]) / 2, [1.01]])
    means = []
    figures = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        there = (answer.confidence[chosen] >= low) & (answer.confidence[chosen] < high)
        if there.sum() >= _LEAST_IN_BIN:
            means.append(float(error[there].mean()))
            name = f"confidence {low:.2f} to {min(1.0, high):.2f}: error, mean"
            figures.append(Figure(name, 100 * means[-1], "cm"))
    rank = spearmanr(np.arange(len(means)), means).statistic if len(means) > 1 else np.nan
    return [*figures, Figure("rank correlation of error and confidence", rank, "", at_most=-0.8)]


def _unknown(probes: AnswerProbes, view: MapView) -> list[Figure]:
    def share(points: Doubles) -> float:
        return float(100 * (view.status(points) == Status.UNKNOWN).mean())

    return [
        Figure(f"{len(probes.never_seen)} never-seen points: unknown", share(probes.never_seen),
               "%", at_least=99),
        Figure(f"{len(probes.seen_free)} points on rays: unknown", share(probes.seen_free), "%",
               at_most=1),
        Figure(f"{len(probes.ghosts)} ghosts of three planes: unknown", share(probes.ghosts), "%",
               at_least=100),
    ]  # fmt: skip


def _corridor(probes: AnswerProbes, view: MapView) -> list[Figure]:
    """Return figures of obstacles around the way of the sensor, where there are none."""
    balls = spheres(view, probes.corridor, np.full(len(probes.corridor), _BALL_M))
    answer = distances(view, probes.corridor, REACH_M)
    false = (balls.status == Status.SURFACE) | (answer.distance_m <= 0)
    return [
        Figure(f"{len(probes.corridor)} balls in the corridor: false obstacles",
               float(false.sum()), "", at_most=0),
        Figure("balls in the corridor: unknown", 100 * (balls.status == Status.UNKNOWN).mean(),
               "%"),
    ]  # fmt: skip


def _along_rays(street: DrivenStreet, rng: np.random.Generator) -> Doubles:
    each = _ALONG_RAYS // len(street.scans)
    points = []
    for scan in street.drive:
        ends = scan.true_hits[rng.integers(len(scan.true_hits), size=each)]
        origin = scan.world_from_sensor[:3, 3]
        lengths = np.linalg.norm(ends - origin, axis=1)
        at = rng.uniform(0.0, np.maximum(lengths - _SHORT_OF_HIT_M, 0.0)) / lengths
        points.append(origin + at[:, None] * (ends - origin))
    return np.concatenate(points)


def _corridor_points(street: DrivenStreet, rng: np.random.Generator) -> Doubles:
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


def _never_seen(street: DrivenStreet, rng: np.random.Generator) -> Doubles:
    hits = street.drive.true_hits(1.0)
    low, high = hits.min(axis=0), hits.max(axis=0)
    under = rng.uniform(low, high, (4 * _NEVER_SEEN, 3))
    under[:, 2] = rng.uniform(low[2] - _DEEP_M[1], low[2] - _DEEP_M[0], len(under))
    deep = street.drive.scene.sdf(under) < -_DEEP_M[0]
    return np.concatenate([street.probes.in_houses, under[deep][:_NEVER_SEEN]])


def _ghosts(street: DrivenStreet, record: MapRecord, rng: np.random.Generator) -> Doubles:
    """Return places that three planes of features cannot tell from seen surface."""
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
