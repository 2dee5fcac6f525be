"""A map of several regions: where they meet, and what each may take."""

import numpy as np
import pytest
from support.maps.small_world import (
    World,
    mapper_of,
    settings,
    settle,
    surface_error,
    take_in,
    world,
)
from support.poses import shifted
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.status import Status
from triquad_server.errors import ScanRefusedError
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.settings import Settings
from triquad_tools.sensors.sweep import moved


def test_regions_meet_without_hole_or_step() -> None:
    """The sensor drives over the border of two regions; the ground must go on."""
    chosen = Settings.model_validate(
        {"field": {"depth": 7}, "training": {"batch": 4096, "samples_per_ray": 9.0}}
    )
    border = chosen.field.region_pitch_m / 2
    drive_through = world(5)
    middle = np.mean([scan.world_from_sensor[0, 3] for scan in drive_through.scans])
    moved = shifted(border - middle)
    mapper = Mapper("test", chosen, "cpu")
    for scan in drive_through.scans:
        mapper.ingest(scan.points, moved @ scan.world_from_sensor)
    settle(mapper)
    epoch = mapper.publish()
    assert epoch.regions >= 2
    along = np.linspace(-4.0, 4.0, 801)
    for y in (1.0, 2.0, 3.0):
        ground = np.stack([border + along, np.full(801, y), np.zeros(801)], 1)
        answer = epoch.query(ground, gradient=False)
        assert np.quantile(np.abs(answer.sdf), 0.95) < 0.05
        assert np.abs(np.diff(answer.sdf)).max() < 0.03, "no step: samples are 1 cm apart"
        assert (answer.status == Status.SURFACE).all(), "no hole"


def test_a_street_across_a_corner_of_regions_is_nearly_as_right_as_in_the_middle_of_one() -> None:
    chosen = Settings.model_validate({"training": {"batch": 4096, "samples_per_ray": 12.0}})
    block_m = BLOCK_VOXELS * chosen.field.leaf_m
    corner = np.round(chosen.field.region_pitch_m / 2 / block_m) * block_m
    errors = [
        surface_error_at(np.array(place), chosen, world(4))
        for place in ((0.0, 0.0, 0.0), (corner, corner, 0.0))
    ]
    # Of so few samples four decoders learn less than one; settled, the benchmark tells.
    assert errors[1] < 1.5 * errors[0]


def surface_error_at(place: np.ndarray, chosen: Settings, drive_through: World) -> float:
    """The error of a settled map of a drive that begins at ``place`` [3]."""
    mapper = Mapper("test", chosen, "cpu")
    for scan in drive_through.scans:
        mapper.ingest(scan.points, shifted(*place) @ scan.world_from_sensor)
    settle(mapper)
    return surface_error(mapper.publish(), drive_through, offset=place)


def test_a_region_that_was_just_entered_is_trained_like_one_that_is_owed_much() -> None:
    chosen = Settings.model_validate({"training": {"batch": 4096}})
    drive_through = world(4)
    mapper = mapper_of(*drive_through.scans, chosen=chosen)
    for _ in range(40):
        mapper.train()
    far = shifted(2 * chosen.field.region_pitch_m)
    first = drive_through.scans[0]
    mapper.ingest(first.points, far @ first.world_from_sensor)
    for _ in range(40):
        mapper.train()
    ends = moved(first.points, far @ first.world_from_sensor)
    assert np.abs(mapper.publish().query(ends).sdf).mean() < 0.03


def test_free_space_is_seen_in_all_regions_that_rays_pass() -> None:
    """A wall beyond the border of two regions, seen from this side of it."""
    chosen = Settings.model_validate({"field": {"depth": 8}})
    half = chosen.field.region_side_m / 2
    mapper = Mapper("test", chosen, "cpu")
    across = np.mgrid[-2:2:0.1, -2:2:0.1].reshape(2, -1).T
    wall = np.column_stack([np.full(len(across), 12.0), across]).astype(np.float32)
    mapper.ingest(wall, shifted(half - 8.0))
    along = np.linspace(half - 7.5, half + 3.5, 200)
    points = np.column_stack([along, np.full(200, 0.05), np.full(200, 0.05)])
    answer = mapper.publish().query(points)
    assert (answer.status == Status.FREE).all()
    assert np.isfinite(answer.sdf).all()


def test_the_number_of_regions_is_bounded() -> None:
    mapper = Mapper("test", settings(max_regions=2), "cpu")
    scan = world().scans[0]
    with pytest.raises(ScanRefusedError) as refusal:
        take_in(mapper, scan)
    assert refusal.value.reason == "too_many_regions"
    assert mapper.publish().regions == 0


def test_the_replay_pool_is_bounded_after_a_restart_and_after_a_reset() -> None:
    mapper = mapper_of(*world(2).scans)
    record = mapper.snapshot_since(None).record()
    assert len(record.regions) > 1
    bounded = settings(pool_bytes=4000 * RAY_BYTES)
    restarted = Mapper("test", bounded, "cpu", record)
    assert restarted.regions.all.rays_kept <= 4000
    restarted.reset(np.array([5.0, -np.inf, -np.inf]), np.full(3, np.inf))
    take_in(restarted, *world(2).scans)
    assert 1000 < restarted.regions.all.rays_kept <= 4000


def test_all_regions_keep_as_many_rays_for_each_voxel_and_tell_what_they_discarded() -> None:
    mapper = Mapper("test", settings(pool_bytes=20_000 * RAY_BYTES), "cpu")
    assert mapper.figures().replay_share == 1.0
    take_in(mapper, *world(6).scans)
    assert mapper.figures().replay_share < 1.0
    sizes = [(len(r.training.rays.pool), r.evidence.live.surface_voxels) for r in mapper.regions]
    densities = [rays / voxels for rays, voxels in sizes if voxels > 100]
    assert len(densities) > 1
    assert max(densities) < 1.2 * min(densities)
    assert mapper.regions.all.rays_kept <= 20_000
    assert mapper.figures().rays_discarded > 20_000


def test_training_beyond_what_the_area_may_owe_is_discarded_and_told() -> None:
    scan = world().scans[0]
    mapper = mapper_of(scan, chosen=settings(rays_per_voxel=0.5))
    voxels = sum(region.evidence.live.surface_voxels for region in mapper.regions)
    assert 0.99 * 10 * voxels < mapper.samples_left <= 10 * voxels
    assert mapper.figures().samples_discarded > 0
