"""Scores as SHINE-Mapping's evaluation defines them, against a slow and literal one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from triquad_client import Mesh
from triquad_tools.evaluation.metrics import ScoreSettings
from triquad_tools.evaluation.shine_protocol import shine_scores, voxel_means

SETTINGS = ScoreSettings(voxel_m=0.05, samples_max=40_000)


def slab(z: float, start: float = 0.0, end: float = 4.0, cells: int = 20) -> Mesh:
    """A level rectangle of 2 m in many triangles."""
    x, y = np.linspace(start, end, cells + 1), np.linspace(0.0, 2.0, cells + 1)
    vertices = np.array([[a, b, z] for a in x for b in y])
    corner = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :-1].ravel()
    lower = np.stack([corner, corner + cells + 1, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + cells + 1, corner + cells + 2], axis=1)
    return Mesh(vertices, np.concatenate([lower, upper]).astype(np.int32), None)


def ground(spacing_m: float = 0.05) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(0.0, 4.0, spacing_m), np.arange(0.0, 2.0, spacing_m))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


@given(st.integers(1, 300), st.floats(0.01, 2.0), st.integers(0, 1000))
def test_each_voxel_becomes_the_mean_of_its_points(count: int, side_m: float, seed: int) -> None:
    points = np.random.default_rng(seed).normal(scale=3.0, size=(count, 3))
    lowest = points.min(axis=0) - side_m / 2
    voxels: dict[tuple[int, ...], list[NDArray[np.float64]]] = {}
    for point in points:
        voxels.setdefault(tuple(np.floor((point - lowest) / side_m).astype(int)), []).append(point)
    wanted = np.array([np.mean(some, axis=0) for some in voxels.values()])
    found = voxel_means(points, side_m)
    assert len(found) == len(wanted)
    assert cKDTree(found).query(wanted)[0].max() < 1e-9


def test_only_faces_that_lie_in_the_box_count() -> None:
    """They may lie outside of it upwards and downwards, by a voxel."""
    inside = shine_scores(slab(0.04), ground(), SETTINGS)
    assert inside.accuracy_m == pytest.approx(0.04, abs=0.01)
    assert inside.accuracy_ratio == 1.0
    assert inside.completion_ratio > 0.95, "but for faces at the edge, which are not all inside"
    above = shine_scores(slab(0.06), ground(), SETTINGS)
    assert above.samples == 0
    assert above.completion_m == SETTINGS.completion_cut_m
    longer = shine_scores(slab(0.0, end=8.0), ground(), SETTINGS)
    assert longer.accuracy_ratio == 1.0, "what lies beyond the truth is cut away"


def test_ratios_and_means_are_those_of_a_literal_evaluation() -> None:
    """Half of the mesh is 15 cm off, a quarter of it is missing."""
    good, off = slab(0.0, end=1.5), slab(0.15, start=1.5, end=3.0)
    faces = np.vstack([good.faces, off.faces + len(good.vertices)])
    mesh = Mesh(np.vstack([good.vertices, off.vertices]), faces, None)
    truth = np.vstack([ground(), [[2.0, 1.0, 1.0]]])  # opens the box upwards
    scores = shine_scores(mesh, truth, SETTINGS)
    assert scores.accuracy_ratio == pytest.approx(0.5, abs=0.03)
    assert scores.accuracy_m == pytest.approx(0.075, abs=0.02)
    assert scores.completion_ratio == pytest.approx(1.5 / 4.0, abs=0.03)
    missing = 0.5 * (0.0 + 1.0) * (1.0 / 4.0) + 0.15 * (1.5 / 4.0)
    assert scores.completion_m == pytest.approx(missing, abs=0.03)


def test_a_mesh_without_faces_has_nothing_to_score() -> None:
    nothing = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32), None)
    scores = shine_scores(nothing, ground(), SETTINGS)
    assert scores.samples == 0
    assert scores.completion_ratio == scores.f_score == 0.0
