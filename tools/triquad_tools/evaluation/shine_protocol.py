"""Scores of a mesh by the protocol of SHINE-Mapping's evaluation, so that figures compare.

Source: ``eval/eval_utils.py`` of SHINE-Mapping (Zhong et al., ICRA 2023), which PIN-SLAM and others
use as well. It differs from :func:`triquad_tools.evaluation.metrics.score_mesh` in these points:
the mesh is cropped to the truth's box exactly, which is widened only upwards and downwards, by one
voxel; a face counts if all of its corners lie inside; as many samples are drawn (ten million
there), whatever the mesh's area; and samples and truth are thinned to the mean of each voxel's
points, not to one of them.

Of MaiCity, papers take two clouds of the truth: one for the completion, and another, which is
cropped to what all methods have meshed, for the accuracy. Here one cloud serves for both.
"""

import numpy as np
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles, Ints

from triquad_tools.evaluation.metrics import MeshScores, ScoreSettings, nearest_m, scores_of


def shine_scores(mesh: Mesh, reference: Doubles, settings: ScoreSettings) -> MeshScores:
    """Return scores of a mesh.

    Args:
        mesh: in the frame of the reference.
        reference: [M, 3] true surface points, metres.
        settings: thresholds, the voxels' side, and how many points are drawn of the mesh.
    """
    faces = faces_inside(mesh, reference, settings.voxel_m)
    drawn = _drawn(mesh.vertices, faces, settings.samples_max, np.random.default_rng(settings.seed))
    points, truth = (voxel_means(some, settings.voxel_m) for some in (drawn, reference))
    distances = nearest_m(truth, points, settings.accuracy_cut_m)
    return scores_of(distances, points, truth, settings)


def voxel_means(points: Doubles, voxel_m: float) -> Doubles:
    """Return the mean of the points [N, 3] of each voxel, as Open3D's ``voxel_down_sample``.

    The lattice begins half a voxel below the least coordinates.
    """
    if not len(points):
        return points
    cells = np.floor((points - points.min(axis=0)) / voxel_m + 0.5).astype(np.int64)
    sides = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sides[1] + cells[:, 1]) * sides[2] + cells[:, 2]
    order = np.argsort(keys)
    ordered = keys[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    sums = np.add.reduceat(points[order], first, axis=0)
    means: Doubles = sums / np.diff(np.append(first, len(keys)))[:, None]
    return means


def faces_inside(mesh: Mesh, reference: Doubles, margin_m: float) -> Ints:
    """Return the faces [F, 3] of which all corners lie in the reference's box.

    It is wider by ``margin_m`` upwards and downwards.
    """
    margin = np.array([0.0, 0.0, margin_m])
    low, high = reference.min(axis=0) - margin, reference.max(axis=0) + margin
    inside = ((mesh.vertices >= low) & (mesh.vertices <= high)).all(axis=1)
    faces: Ints = mesh.faces[inside[mesh.faces].all(axis=1)]
    return faces


def _drawn(vertices: Doubles, faces: Ints, count: int, rng: np.random.Generator) -> Doubles:
    """Return points [count, 3], evenly by area; none where there is no face."""
    if not len(faces):
        return np.empty((0, 3))
    first, second, third = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
    areas = np.linalg.norm(np.cross(second - first, third - first), axis=1)
    chosen = np.repeat(np.arange(len(faces)), rng.multinomial(count, areas / areas.sum()))
    # Osada et al. 2002, "Shape distributions", section 4.2.
    root, along = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    points: Doubles = (1 - root) * first[chosen] + root * (1 - along) * second[chosen]
    points += root * along * third[chosen]
    return points
