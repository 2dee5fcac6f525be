import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.maps.surface_samples import surface_samples
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box, cylinder, gable, sphere
from triquad_tools.simulation.street import street

BOUNDS = np.array([[-4.0, -4.0, -4.0], [4.0, 4.0, 4.0]])

ONE_SOLID = {
    "box": box((0.3, -0.2, 0.1), (1.0, 0.7, 0.5), yaw=0.4),
    "rounded box": box((0.3, -0.2, 0.1), (1.0, 0.7, 0.5), yaw=-2.0, radius=0.2),
    "cylinder": cylinder((0.3, -0.2, 0.1), 0.4, 1.1),
    "gable": gable((0.3, -0.2, 0.1), (1.2, 0.8, 0.9), eave=1.1, yaw=0.7),
    "sphere": sphere((0.3, -0.2, 0.1), 0.8),
}


@pytest.fixture(scope="module")
def world() -> Scene:
    return street(3, length_m=30.0)


def _near_surface(scene: Scene, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    samples = surface_samples(scene, 0.2, rng)
    chosen = samples[rng.integers(len(samples), size=count)]
    return chosen + rng.uniform(-0.3, 0.3, chosen.shape)


@pytest.mark.parametrize("name", ONE_SOLID)
def test_distance_of_a_solid_agrees_with_the_distance_to_samples_of_its_surface(name: str) -> None:
    rng = np.random.default_rng(0)
    scene = Scene((ONE_SOLID[name],), BOUNDS)
    samples = surface_samples(scene, 0.01, rng)
    points = rng.uniform(-1.8, 1.8, (20_000, 3))
    brute = cKDTree(samples).query(points)[0]
    exact = np.abs(scene.sdf(points))
    assert np.all(exact <= brute + 1e-9)
    far = brute > 0.05  # nearer, the spacing of the samples shows
    assert np.max(brute[far] - exact[far]) < 0.015


@pytest.mark.parametrize("name", ONE_SOLID)
def test_gradient_of_a_solid_agrees_with_finite_differences(name: str) -> None:
    scene = Scene((ONE_SOLID[name],), BOUNDS)
    points = np.random.default_rng(1).uniform(-1.8, 1.8, (5_000, 3))
    assert _gradient_error(scene, points, scene.gradient(points)) < 0.005


def _gradient_error(scene: Scene, points: np.ndarray, gradients: np.ndarray) -> float:
    """Share of points, mostly on medial planes, where central differences disagree."""
    step = 1e-6
    shifts = step * np.eye(3)
    slopes = [(scene.sdf(points + h) - scene.sdf(points - h)) / (2.0 * step) for h in shifts]
    return float(np.mean(np.abs(np.stack(slopes, axis=1) - gradients).max(axis=1) > 1e-4))


def test_grid_of_candidates_changes_no_answer(world: Scene) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(world.bounds[0] - 5.0, world.bounds[1] + 5.0, (20_000, 3))
    alone = [Scene((solid,), world.bounds).sdf(points) for solid in world.solids]
    np.testing.assert_array_equal(world.sdf(points), np.min(alone, axis=0))


def test_distance_near_the_surface_is_exact_but_beside_seams(world: Scene) -> None:
    points = _near_surface(world, 20_000, seed=6)
    exact = world.is_exact(points)
    assert np.all(exact[world.sdf(points) >= 0.0])
    assert np.mean(exact) > 0.95


def test_gradient_is_a_unit_vector_and_the_slope_of_the_distance(world: Scene) -> None:
    points = _near_surface(world, 5_000, seed=7)
    gradients = world.gradient(points)
    np.testing.assert_allclose(np.linalg.norm(gradients, axis=1), 1.0, atol=1e-12)
    assert _gradient_error(world, points, gradients) < 0.005


def test_inside_of_houses_is_deep_in_houses_only(world: Scene) -> None:
    rng = np.random.default_rng(8)
    points = rng.uniform(world.bounds[0], world.bounds[1], (50_000, 3))
    inside = world.is_inside_house(points, margin_m=0.8)
    assert 0.02 < np.mean(inside) < 0.5
    assert np.all(world.sdf(points[inside]) < -0.8)
    assert not world.is_inside_house(np.array([[15.0, 0.0, 1.0], [15.0, 0.0, -3.0]])).any()


def test_street_depends_on_its_seed_alone() -> None:
    assert street(1, 20.0).solids == street(1, 20.0).solids
    assert street(1, 20.0).solids != street(2, 20.0).solids


@pytest.mark.parametrize("shape", [(3,), (4, 2)])
def test_points_of_another_shape_are_refused(world: Scene, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected points \[N, 3\]"):
        world.sdf(np.zeros(shape))


def test_solids_of_impossible_size_are_refused() -> None:
    with pytest.raises(ValueError, match="radius 0.6"):
        box((0.0, 0.0, 0.0), (1.0, 0.5, 1.0), radius=0.6)
    with pytest.raises(ValueError, match="eave 3"):
        gable((0.0, 0.0, 0.0), (1.0, 0.5, 1.0), eave=3.0)
