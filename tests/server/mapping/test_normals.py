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


def test_a_line_of_points_has_no_normal() -> None:
    normals = SurfaceNormals(0.2, TEAM)
    line = np.linspace(0, 10, 400)[:, None] * np.array([1.0, 0.3, 0.0])
    assert np.isnan(normals.add(line, np.zeros(3))).all()


def test_later_scans_fill_in_what_one_line_cannot_tell() -> None:
    normals = SurfaceNormals(0.2, TEAM)
    lines = [np.stack([np.linspace(0, 8, 60), np.full(60, y), np.zeros(60)], 1) for y in (0, 0.4)]
    assert np.isnan(normals.add(lines[0], np.zeros(3))).all()
    normals.add(lines[1], np.zeros(3))
    found = normals.add(lines[0], np.zeros(3))
    known = ~np.isnan(found[:, 0])
    assert known.mean() > 0.8
    np.testing.assert_allclose(np.abs(found[known][:, 2]), 1, atol=1e-5)


def test_scattered_points_have_no_normal() -> None:
    normals = SurfaceNormals(0.2, TEAM)
    points = RNG.uniform(-1, 1, (3000, 3))
    assert np.isnan(normals.add(points, np.zeros(3))[:, 0]).mean() > 0.95


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


def test_forgetting_a_box() -> None:
    normals = SurfaceNormals(0.2, TEAM)
    points = plane(np.array([0.0, 0.0, 1.0]), 8000, 3.0, 0.0)
    normals.add(points, np.zeros(3))
    middle = points.mean(axis=0)
    normals.forget(middle - [9, 9, 9], middle + [0, 9, 9])
    few = points[::800]  # too few to tell a plane by themselves
    known = ~np.isnan(normals.add(few, np.zeros(3))[:, 0])
    assert not known[few[:, 0] < middle[0] - 1].any()
    assert known[few[:, 0] > middle[0] + 1].mean() > 0.9
