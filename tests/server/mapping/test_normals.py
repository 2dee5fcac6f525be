import numpy as np
from triquad_server.mapping.replay.normals import SurfaceNormals
from triquad_server.process.threads import Teams

TEAM = Teams().mapping
RNG = np.random.default_rng(0)


def plane(normal: np.ndarray, count: int, side_m: float, noise_m: float) -> np.ndarray:
    axes = np.linalg.svd(normal[None])[2][1:]
    points = RNG.uniform(-side_m, side_m, (count, 2)) @ axes
    return points + RNG.normal(0, noise_m, (count, 1)) * normal + [100.0, -40.0, 7.0]


def test_the_normal_of_a_noisy_plane() -> None:
    for _ in range(5):
        normal = RNG.normal(size=3)
        normal /= np.linalg.norm(normal)
        normals = SurfaceNormals(0.2, TEAM)
        points = plane(normal, 4000, 2.0, 0.01)
        found = normals.add(points, np.zeros(3))
        known = ~np.isnan(found[:, 0])
        assert known.mean() > 0.9
        angles = np.degrees(np.arccos(np.clip(np.abs(found[known] @ normal), 0, 1)))
        assert np.median(angles) < 4
        np.testing.assert_allclose(np.linalg.norm(found[known], axis=1), 1, atol=1e-5)


def test_memory_is_bounded_and_the_surroundings_stay_known() -> None:
    normals = SurfaceNormals(0.2, TEAM, max_cells=4000)
    ground = np.zeros((40_000, 3))
    for x in range(0, 200, 10):
        ground[:, :2] = RNG.uniform([x - 10, -10], [x + 10, 10], (40_000, 2))
        normals.add(ground, np.array([x, 0.0, 1.8]))
    near = np.array([[x, y, 0.0] for x in (188.0, 190, 192) for y in (-1.0, 0, 1)])
    sensor = np.array([190.0, 0.0, 1.8])
    np.testing.assert_allclose(np.abs(normals.add(near, sensor)[:, 2]), 1, atol=1e-5)
    behind = normals.add(np.zeros((1, 3)), sensor)
    assert np.isnan(behind).all(), "what lies far behind is forgotten"
