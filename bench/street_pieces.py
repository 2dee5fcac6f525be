"""Scores of pieces of a long street, which as a whole would take too long to score."""

import statistics
from collections.abc import Callable, Iterable

import numpy as np
from triquad_client import Mesh
from triquad_client.checks import Bounds
from triquad_tools.evaluation.metrics import ScoreSettings, score_mesh
from triquad_tools.recordings.cloud import merged
from triquad_tools.simulation.lidar import SimulatedDrive
from triquad_tools.simulation.scene import Scene

PIECE_M = 40.0
REACH_M = 60.0  # beyond a place, for what is seen from there

_VOXEL_M = 0.05


def mean_f_score(
    drive: SimulatedDrive, mesh: Callable[[Bounds], Mesh], firsts_m: Iterable[float]
) -> float:
    """Return the mean F-score of the pieces that begin at some metres of a drive along x.

    ``mesh`` returns the mesh of a box. The drive goes evenly from 0 on.
    """
    scores = []
    x = drive.poses[:, 0, 3]
    for first_m in firsts_m:
        scene = _piece(drive.scene, first_m)
        near = (x > first_m - REACH_M) & (x < first_m + PIECE_M + REACH_M)
        low, high = scene.bounds
        hits = (drive.scan(number).true_hits for number in np.flatnonzero(near).tolist())
        inside = (some[((some >= low) & (some <= high)).all(axis=1)] for some in hits)
        visible = merged(inside, _VOXEL_M)
        found = score_mesh(mesh(scene.box), visible, ScoreSettings(), scene.sdf)
        scores.append(found.f_score)
    return statistics.mean(scores)


def _piece(scene: Scene, first_m: float) -> Scene:
    """Return a piece of a street, with what is around it."""
    low, high = scene.bounds.copy()
    low[0], high[0] = first_m, first_m + PIECE_M
    solids = tuple(
        solid
        for solid in scene.solids
        if low[0] - REACH_M < solid.centre[0] + solid.bound_m
        and solid.centre[0] - solid.bound_m < high[0] + REACH_M
    )
    return Scene(solids, np.array([low, high]))
