import numpy as np
import pytest
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box, cylinder, gable, sphere
from triquad_tools.simulation.street import street

BOUNDS = np.array([[-4.0, -4.0, -4.0], [4.0, 4.0, 4.0]])

CENTRE = (0.3, -0.2, 0.1)
SOLIDS = {
    "box": (
        box(CENTRE, (1.0, 0.7, 0.5), yaw=0.4),
        [(1.0, 0.0, 0.0), (0.3, -0.7, 0.2), (1.0, 0.7, 0.5), (0.0, 0.0, -0.5)],
    ),
    "rounded box": (
        box(CENTRE, (1.0, 0.7, 0.5), yaw=-2.0, radius=0.2),
        [(1.0, 0.0, 0.0), (0.8 + 0.2 / 2**0.5, 0.5 + 0.2 / 2**0.5, 0.1), (0.3, 0.2, 0.5)],
    ),
    "cylinder": (
        cylinder(CENTRE, 0.4, 1.1),
        [(0.4, 0.0, 0.3), (0.0, -0.4, -1.0), (0.1, 0.2, 1.1), (0.4, 0.0, -1.1)],
    ),
    "gable": (
        gable(CENTRE, (1.2, 0.8, 0.9), eave=1.1, yaw=0.7),
        [(0.3, 0.0, 0.9), (1.2, 0.8, 0.2), (0.4, -0.8, -0.5), (1.2, 0.1, 0.0), (0.5, 0.4, 0.55)],
    ),
    "sphere": (sphere(CENTRE, 0.8), [(0.8, 0.0, 0.0), (0.0, 0.48, -0.64)]),
}
"""Solids, and points on the surface of each, from its centre and before it is turned."""


@pytest.fixture(scope="module")
def world() -> Scene:
    return street(3, length_m=30.0)


def _near_surface(scene: Scene, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform(*scene.bounds, (4 * count, 3))
    points -= scene.sdf(points)[:, None] * scene.gradient(points)
    on_surface = points[np.abs(scene.sdf(points)) < 1e-6]
    return on_surface[:count] + rng.uniform(-0.3, 0.3, (len(on_surface[:count]), 3))


@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_lies_where_it_should_and_tells_the_way_to_its_nearest_surface(name: str) -> None:
    """Slopes of one, and nearest points on the surface: so distances are those to these points."""
    solid, known = SOLIDS[name]
    scene = Scene((solid,), BOUNDS)
    cos, sin = np.cos(solid.yaw), np.sin(solid.yaw)
    turned = np.array(known) @ [[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]] + CENTRE
    np.testing.assert_allclose(scene.sdf(turned), 0.0, atol=1e-9)
    assert scene.sdf(np.array([CENTRE]))[0] < -0.3
    points = np.random.default_rng(1).uniform(-1.8, 1.8, (5_000, 3))
    gradients = scene.gradient(points)
    nearest = points - scene.sdf(points)[:, None] * gradients
    assert np.abs(scene.sdf(nearest)).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(gradients, axis=1), 1.0, atol=1e-9)
    assert _gradient_error(scene, points, gradients) < 0.005


def _gradient_error(scene: Scene, points: np.ndarray, gradients: np.ndarray) -> float:
    """Share of points, mostly on medial planes, where central differences disagree."""
    step = 1e-6
    shifts = step * np.eye(3)
    slopes = [(scene.sdf(points + h) - scene.sdf(points - h)) / (2.0 * step) for h in shifts]
    return float(np.mean(np.abs(np.stack(slopes, axis=1) - gradients).max(axis=1) > 1e-4))


def test_distance_is_that_to_the_nearest_solid(world: Scene) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(world.bounds[0] - 5.0, world.bounds[1] + 5.0, (20_000, 3))
    alone = [Scene((solid,), world.bounds).sdf(points) for solid in world.solids]
    np.testing.assert_array_equal(world.sdf(points), np.min(alone, axis=0))


def test_distance_near_the_surface_is_exact_but_beside_seams(world: Scene) -> None:
    points = _near_surface(world, 20_000, seed=6)
    exact = world.is_exact(points)
    assert np.all(exact[world.sdf(points) >= 0.0])
    assert np.mean(exact) > 0.95


def test_inside_of_houses_is_deep_in_houses_only(world: Scene) -> None:
    rng = np.random.default_rng(8)
    points = rng.uniform(world.bounds[0], world.bounds[1], (50_000, 3))
    inside = world.is_inside_house(points, margin_m=0.8)
    assert 0.02 < np.mean(inside) < 0.5
    assert np.all(world.sdf(points[inside]) < -0.8)
    assert not world.is_inside_house(np.array([[15.0, 0.0, 1.0], [15.0, 0.0, -3.0]])).any()


def test_solids_of_impossible_size_are_refused() -> None:
    with pytest.raises(ValueError, match="radius 0.6"):
        box((0.0, 0.0, 0.0), (1.0, 0.5, 1.0), radius=0.6)
    with pytest.raises(ValueError, match="eave 3"):
        gable((0.0, 0.0, 0.0), (1.0, 0.5, 1.0), eave=3.0)
