import numpy as np
import pytest
from triquad_server.engine.live_field import Batch
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.replay.ray_table import (
    Placement,
    RayTable,
    draw_ordered_samples,
    rays_through,
)
from triquad_server.process.threads import Teams
from triquad_server.settings import ScanSettings

HALF_SIDE_M = 400.0
TEAM = Teams().mapping
CENTRE = np.array([10.0, -20.0, 3.0])


def rays_to_ground(count: int = 500, height_m: float = 2.0) -> ScanRays:
    rng = np.random.default_rng(0)
    ends = np.column_stack([rng.uniform(2, 30, (count, 1)), rng.uniform(-9, 9, (count, 1))])
    ends = np.column_stack([ends, np.zeros(count)])
    return ScanRays(np.array([0, 0, height_m]), ends, points_dropped={})


def placed(settings: ScanSettings, half_side_m: float = HALF_SIDE_M) -> Placement:
    return Placement(
        settings.surface_share,
        settings.spread_m,
        settings.behind_m,
        half_side_m,
    )


def kept(rays: ScanRays, normals: np.ndarray, centre: np.ndarray, placement: Placement) -> RayTable:
    used = np.ones(len(rays.ends), np.bool_)
    return rays_through(rays, normals, used, centre, placement, np.random.default_rng(2))


def draw(table: RayTable, chosen: np.ndarray, placement: Placement) -> Batch:
    return draw_ordered_samples(table, chosen, placement, np.random.default_rng(1), TEAM)


def test_with_normals_the_label_is_the_distance_to_the_plane() -> None:
    settings = ScanSettings()
    rays = rays_to_ground()
    down = np.tile([0.0, 0.0, -1.0], (500, 1))
    table = kept(rays, down, CENTRE, placed(settings))
    batch = draw(table, np.arange(500).repeat(20), placed(settings))
    heights = batch.points[:, 2] + CENTRE[2]
    labels = batch.labels
    assert abs(labels - heights).max() < 0.05, "up to the least cosine"
    far = np.abs(labels) > 1e-3
    assert (np.sign(labels) == np.sign(heights))[far].all(), "positive above the ground"


def test_without_normals_the_label_is_the_distance_along_the_ray() -> None:
    settings = ScanSettings()
    rays = rays_to_ground(1)
    table = kept(rays, np.full((1, 3), np.nan), CENTRE, placed(settings))
    batch = draw(table, np.zeros(3000, np.int64), placed(settings))
    points = batch.points + CENTRE
    distance = np.linalg.norm(points - rays.ends[0], axis=1)
    np.testing.assert_allclose(np.abs(batch.labels), distance, atol=1e-4)
    assert (np.sign(batch.labels) == np.sign(points[:, 2]))[distance > 1e-3].all()


def test_samples_lie_where_the_settings_say() -> None:
    settings = ScanSettings(surface_share=0.7, spread_m=0.1)
    rays = rays_to_ground(1)
    range_m = np.linalg.norm(rays.ends[0] - rays.origin)
    table = kept(rays, np.full((1, 3), np.nan), CENTRE, placed(settings))
    batch = draw(table, np.zeros(20_000, np.int64), placed(settings))
    reach = np.linalg.norm(batch.points + CENTRE - rays.origin, axis=1)
    assert reach.min() < 0.01 * range_m
    assert reach.max() <= range_m + 0.8 + 1e-4
    near = np.abs(reach - range_m) <= 0.3
    free_near = 0.6 / (range_m + 0.8)  # of the free samples that lie there by chance
    assert near.mean() == pytest.approx(0.7 + 0.3 * free_near, abs=0.02)
    assert np.std(reach[near] - range_m) == pytest.approx(0.1, abs=0.02)


def test_samples_stay_inside_the_cube() -> None:
    settings = ScanSettings()
    half = 8.0
    rays = rays_to_ground()
    table = kept(rays, np.full((500, 3), np.nan), np.zeros(3), placed(settings, half))
    ending = (np.abs(rays.ends) < half).all(axis=1).sum()
    assert len(table) > ending, "rays that only pass through teach free space"
    batch = draw(table, np.arange(len(table)).repeat(10), placed(settings, half))
    assert np.abs(batch.points).max() <= half + 1e-4
