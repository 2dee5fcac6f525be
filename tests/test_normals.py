import numpy as np
from triquad_server.normals import SurfaceNormals

RNG = np.random.default_rng(0)


def plane(normal: np.ndarray, count: int, side_m: float, noise_m: float) -> np.ndarray:
    axes = np.linalg.svd(normal[None])[2][1:]
    points = RNG.uniform(-side_m, side_m, (count, 2)) @ axes
    return points + RNG.normal(0, noise_m, (count, 1)) * normal + [100.0, -40.0, 7.0]


def test_the_normal_of_a_noisy_plane() -> None:
    for _ in range(5):
        normal = RNG.normal(size=3)
        normal /= np.linalg.norm(normal)
        normals = SurfaceNormals()
        points = plane(normal, 4000, 2.0, 0.01)
        normals.add(points)
        found = normals.at(points)
        known = ~np.isnan(found[:, 0])
        assert known.mean() > 0.9
        angles = np.degrees(np.arccos(np.clip(np.abs(found[known] @ normal), 0, 1)))
        assert np.median(angles) < 4
        np.testing.assert_allclose(np.linalg.norm(found[known], axis=1), 1, atol=1e-9)


def test_a_line_of_points_has_no_normal() -> None:
    normals = SurfaceNormals()
    line = np.linspace(0, 10, 400)[:, None] * np.array([1.0, 0.3, 0.0])
    normals.add(line)
    assert np.isnan(normals.at(line)).all()


def test_later_scans_fill_in_what_one_line_cannot_tell() -> None:
    normals = SurfaceNormals()
    lines = [np.stack([np.linspace(0, 8, 60), np.full(60, y), np.zeros(60)], 1) for y in (0, 0.4)]
    normals.add(lines[0])
    assert np.isnan(normals.at(lines[0])).all()
    normals.add(lines[1])
    found = normals.at(lines[0])
    known = ~np.isnan(found[:, 0])
    assert known.mean() > 0.8
    np.testing.assert_allclose(np.abs(found[known][:, 2]), 1, atol=1e-6)


def test_scattered_points_have_no_normal() -> None:
    normals = SurfaceNormals()
    points = RNG.uniform(-1, 1, (3000, 3))
    normals.add(points)
    assert np.isnan(normals.at(points)[:, 0]).mean() > 0.95
