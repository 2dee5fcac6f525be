import numpy as np
import pytest
from triquad_server.sampling import draw_samples
from triquad_server.scan import IngestReport, Rays
from triquad_server.settings import ScanSettings


def rays_to_ground(count: int = 500, height_m: float = 2.0) -> Rays:
    rng = np.random.default_rng(0)
    ends = np.column_stack([rng.uniform(2, 30, (count, 1)), rng.uniform(-9, 9, (count, 1))])
    ends = np.column_stack([ends, np.zeros(count)])
    return Rays(np.array([0, 0, height_m]), ends, IngestReport(count, {}))


def draw(normals: np.ndarray, **changes: float) -> tuple[np.ndarray, np.ndarray, Rays]:
    rays = rays_to_ground()
    settings = ScanSettings(**changes)
    samples = draw_samples(rays, normals, settings, np.random.default_rng(1))
    count = settings.surface_samples + settings.free_samples
    return samples.points.reshape(-1, count, 3), samples.labels.reshape(-1, count), rays


def test_with_normals_the_label_is_the_distance_to_the_plane() -> None:
    points, labels, _ = draw(np.tile([0.0, 0.0, -1.0], (500, 1)))
    assert abs(labels - points[..., 2]).max() < 0.05, "up to the least cosine"
    far = np.abs(labels) > 1e-3
    assert (np.sign(labels) == np.sign(points[..., 2]))[far].all(), "positive above the ground"


def test_without_normals_the_label_is_the_distance_along_the_ray() -> None:
    points, labels, rays = draw(np.full((500, 3), np.nan))
    distance = np.linalg.norm(points - rays.ends[:, None], axis=2)
    np.testing.assert_allclose(np.abs(labels), distance, atol=1e-5)
    assert (np.sign(labels) == np.sign(points[..., 2]))[distance > 1e-3].all()


def test_samples_lie_where_the_settings_say() -> None:
    points, _, rays = draw(np.full((500, 3), np.nan), surface_samples=4, free_samples=2)
    ranges = np.linalg.norm(rays.ends - rays.origin, axis=1)[:, None]
    reach = np.linalg.norm(points - rays.origin, axis=2)
    near, free = reach[:, :4] - ranges, reach[:, 4:]
    assert np.abs(near).max() <= 0.3 + 1e-9
    assert np.abs(near).max() > 0.29
    assert (free >= 0.3 * ranges - 1e-9).all()
    assert (free <= ranges + 0.8 + 1e-9).all()


@pytest.mark.parametrize("free", [0, 1])
def test_free_samples_can_be_left_out(free: int) -> None:
    points, _, _ = draw(np.full((500, 3), np.nan), free_samples=free)
    assert points.shape[1] == 3 + free
