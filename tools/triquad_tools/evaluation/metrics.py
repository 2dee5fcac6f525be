"""Scores of a mesh, as the literature on neural mapping defines them.

Accuracy goes from the mesh to the truth, completion from the truth to the mesh. The mesh is
sampled densely; samples and truth are thinned to one point per voxel. Samples outside the truth's
bounding box are left out, and so are those farther from the truth than the accuracy's cut: they
count in ``outlier_ratio`` alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles

from triquad_tools.recordings.cloud import thin


@dataclass(frozen=True)
class ScoreSettings:
    """The settings of the scores; the defaults are those used on MaiCity."""

    threshold_m: float = 0.1  # nearer than this counts as right, in both ratios
    accuracy_cut_m: float = 0.2  # samples farther than this are left out
    completion_cut_m: float = 2.0  # greater distances count as this
    voxel_m: float = 0.02  # samples and truth are thinned to this
    samples_max: int = 3_000_000  # of a mesh, before thinning: more change scores by little
    seed: int = 0  # of these samples: scores can be repeated


@dataclass(frozen=True)
class MeshScores:
    """The agreement of a mesh with the truth; NaN if the mesh has no samples to score."""

    accuracy_m: float  # mean distance, samples to truth
    accuracy_median_m: float
    accuracy_ratio: float  # share of samples nearer than the threshold
    completion_m: float  # mean distance, truth to samples
    completion_ratio: float  # share of the truth nearer than the threshold
    f_score: float  # harmonic mean of both ratios
    outlier_ratio: float  # share of samples beyond the accuracy's cut
    samples: int  # of the mesh, in the truth's bounding box
    references: int  # points of the truth


def score_mesh(
    mesh: Mesh,
    reference: Doubles,
    settings: ScoreSettings,
    distance: Callable[[Doubles], Doubles] | None = None,
) -> MeshScores:
    """Return scores of a mesh.

    The spacing of the reference bounds the accuracy from below: a cloud of 3 cm spacing shows no
    mesh as better than about 1.5 cm.

    Args:
        mesh: in the frame of the reference.
        reference: ``[M, 3]`` true surface points, metres, which the mesh should have.
        settings: thresholds.
        distance: returns how far points ``[N, 3]`` are from the truth, where that is known exactly;
            ``None``: how far from the reference.
    """
    if len(reference) == 0:
        raise ValueError("no reference points to score against")
    points = thin(np.asarray(reference, np.float64), settings.voxel_m)
    samples = _samples(mesh, points, settings)
    if distance is None:
        distances = nearest_m(points, samples, settings.accuracy_cut_m)
    else:
        distances = np.abs(distance(samples))
    return scores_of(distances, samples, points, settings)


def _samples(mesh: Mesh, reference: Doubles, settings: ScoreSettings) -> Doubles:
    import trimesh.sample  # slow to import

    surface = mesh.to_trimesh()
    # More than four samples per voxel's face would only be thinned away again.
    count = min(int(surface.area / (0.5 * settings.voxel_m) ** 2), settings.samples_max)
    if count == 0:
        return np.empty((0, 3))
    samples = trimesh.sample.sample_surface(surface, count, seed=settings.seed)[0]
    # Below a level road, which is the very bottom of its box, samples are errors to be counted.
    margin_m = settings.accuracy_cut_m
    low, high = reference.min(axis=0) - margin_m, reference.max(axis=0) + margin_m
    inside = ((samples >= low) & (samples <= high)).all(axis=1)
    return thin(samples[inside], settings.voxel_m)


def nearest_m(points: Doubles, places: Doubles, limit_m: float) -> Doubles:
    """Return the distances [N] of places [N, 3] to the nearest point; infinite beyond a limit."""
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)  # much faster to build
    return np.asarray(tree.query(places, distance_upper_bound=limit_m, workers=-1)[0])


def scores_of(
    distances: Doubles, samples: Doubles, truth: Doubles, settings: ScoreSettings
) -> MeshScores:
    """Return scores of a mesh's samples [N, 3], ``distances`` [N] from the truth [M, 3]."""
    cut_m = settings.completion_cut_m
    missing_m = np.minimum(nearest_m(samples, truth, cut_m), cut_m)
    kept = distances[distances < settings.accuracy_cut_m]
    accuracy_ratio = mean_or_nan(kept < settings.threshold_m)
    completion_ratio = mean_or_nan(missing_m < settings.threshold_m)
    total = accuracy_ratio + completion_ratio
    return MeshScores(
        accuracy_m=mean_or_nan(kept),
        accuracy_median_m=float(np.median(kept)) if len(kept) else float("nan"),
        accuracy_ratio=accuracy_ratio,
        completion_m=mean_or_nan(missing_m),
        completion_ratio=completion_ratio,
        f_score=2.0 * accuracy_ratio * completion_ratio / total if total > 0.0 else 0.0,
        outlier_ratio=1.0 - len(kept) / len(distances) if len(distances) else float("nan"),
        samples=len(distances),
        references=len(missing_m),
    )


def mean_or_nan(values: NDArray[np.floating | np.bool_]) -> float:
    """Return the mean of values [N], or the share of true ones; NaN if there are none."""
    return float(np.mean(values)) if len(values) else float("nan")
