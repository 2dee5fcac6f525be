import numpy as np
import pytest
from triquad_client import Mesh
from triquad_tools.evaluation.metrics import ScoreSettings, score_mesh
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import half_space

NOTHING = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64))
BOUNDS = np.array([[0.0, 0.0, -1.0], [4.0, 2.0, 1.0]])
GROUND = Scene((half_space(0.0),), BOUNDS)


def _plate(x: float, y: float, z: float, start: float = 0.0) -> Mesh:
    """A level rectangle from ``start`` to ``x`` and 0 to ``y`` at height ``z``."""
    vertices = np.array([[start, 0.0, z], [x, 0.0, z], [x, y, z], [start, y, z]])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]))


def _grid(z: float = 0.0) -> np.ndarray:
    """A cloud of 2 cm spacing over 4 m x 2 m."""
    x, y = np.meshgrid(np.arange(0.01, 4.0, 0.02), np.arange(0.01, 2.0, 0.02))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def test_parallel_planes_score_their_distance_against_a_scene() -> None:
    scores = score_mesh(_plate(4.0, 2.0, 0.05), _grid(), ScoreSettings(), GROUND.sdf)
    assert scores.accuracy_m == pytest.approx(0.05, abs=1e-9)
    assert scores.accuracy_median_m == pytest.approx(0.05, abs=1e-9)
    assert scores.completion_m == pytest.approx(0.05, abs=0.002)
    assert scores.accuracy_ratio == scores.completion_ratio == scores.f_score == 1.0
    assert scores.outlier_ratio == 0.0
    assert scores.references == 200 * 100


def test_samples_beyond_the_cut_are_left_out_and_counted() -> None:
    near, far = _plate(4.0, 2.0, 0.02), _plate(4.0, 2.0, 0.5)
    both = Mesh(np.vstack([near.vertices, far.vertices]), np.vstack([near.faces, far.faces + 4]))
    visible = np.vstack([_grid(), [[2.0, 1.0, 1.0]]])  # opens the bounding box upwards
    for scores in (
        score_mesh(both, visible, ScoreSettings(), GROUND.sdf),
        score_mesh(both, visible, ScoreSettings()),
    ):
        assert scores.accuracy_m == pytest.approx(0.02, abs=0.005)
        assert scores.accuracy_ratio == 1.0
        assert scores.outlier_ratio == pytest.approx(0.5, abs=0.01)


def test_half_a_mesh_completes_half_the_truth() -> None:
    settings = ScoreSettings(completion_cut_m=0.5)
    scores = score_mesh(_plate(2.0, 2.0, 0.0), _grid(), settings, GROUND.sdf)
    assert scores.accuracy_m == pytest.approx(0.0, abs=1e-9)
    assert scores.accuracy_ratio == 1.0
    assert scores.completion_ratio == pytest.approx(2.1 / 4.0, abs=0.01)
    # Gaps grow from 0 to 0.5 m over half a metre and stay there for another 1.5 m.
    assert scores.completion_m == pytest.approx((0.25 * 0.5 + 0.5 * 1.5) / 4.0, abs=0.01)
    ratios = (scores.accuracy_ratio, scores.completion_ratio)
    assert scores.f_score == pytest.approx(2.0 * ratios[0] * ratios[1] / sum(ratios))


def test_settings_are_heeded() -> None:
    settings = ScoreSettings(threshold_m=0.04, voxel_m=0.1, accuracy_cut_m=0.3)
    scores = score_mesh(_plate(4.0, 2.0, 0.25), _grid(), settings, GROUND.sdf)
    assert scores.accuracy_m == pytest.approx(0.25)
    assert scores.accuracy_ratio == 0.0
    assert scores.references == 40 * 20
    assert scores.samples == pytest.approx(800, rel=0.15)
    few = ScoreSettings(samples_max=100)
    assert score_mesh(_plate(4.0, 2.0, 0.0), _grid(), few).samples <= 100


def test_an_empty_mesh_scores_nothing() -> None:
    scores = score_mesh(NOTHING, _grid(), ScoreSettings())
    assert np.isnan(scores.accuracy_m)
    assert scores.completion_m == 2.0
    assert (scores.completion_ratio, scores.f_score, scores.samples) == (0.0, 0.0, 0)
    exact = score_mesh(NOTHING, _grid(), ScoreSettings(), GROUND.sdf)
    assert (exact.completion_ratio, exact.f_score, exact.samples) == (0.0, 0.0, 0)


def test_scores_without_a_truth_are_refused() -> None:
    with pytest.raises(ValueError, match="no reference points"):
        score_mesh(_plate(1.0, 1.0, 0.0), np.empty((0, 3)), ScoreSettings())
