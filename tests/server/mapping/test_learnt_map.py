"""What a map has learnt of a street, and how right it is."""

import numpy as np
import pytest
from support.maps.small_world import (
    settings,
    settle,
    settled,
    settled_mapper,
    surface_error,
    take_in,
    world,
)
from triquad_format.records.status import Status
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.replay.kept_rays import RAY_BYTES


@pytest.fixture(scope="module")
def mapped() -> Mapper:
    return settled()


def test_the_map_is_right_near_surfaces(mapped: Mapper) -> None:
    assert surface_error(mapped.publish(), world()) < 0.02


def test_gradients_point_away_from_surfaces(mapped: Mapper) -> None:
    scene, hits, epoch = world().scene, world().hits[::50], mapped.publish()
    hits = hits[epoch.status(hits) == Status.SURFACE]
    normals = scene.gradient(hits)
    answer = epoch.query(hits + 0.03 * normals, gradient=True)
    unit = answer.gradient / np.linalg.norm(answer.gradient, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip((unit * normals).sum(axis=1), -1, 1)))
    assert np.median(angles) < 12


def test_what_was_seen_is_told_from_what_was_not(mapped: Mapper) -> None:
    epoch, scene = mapped.publish(), world().scene
    hits = world().hits
    # Single returns from far away, with none beside them, are no surface yet.
    assert (epoch.status(hits) == Status.SURFACE).mean() > 0.97
    between = [
        scan.world_from_sensor[:3, 3] + 0.5 * (hit - scan.world_from_sensor[:3, 3])
        for scan in world().scans
        for hit in scan.true_hits[::500]
    ]
    assert (epoch.status(np.array(between)) != Status.UNKNOWN).mean() > 0.95
    rng = np.random.default_rng(0)
    inside = rng.uniform(hits.min(axis=0), hits.max(axis=0), (200_000, 3))
    inside = inside[scene.is_inside_house(inside, 0.5)]
    assert len(inside) > 1000
    assert (epoch.status(inside) == Status.UNKNOWN).mean() > 0.98


def test_ghost_cells_are_unknown(mapped: Mapper) -> None:
    """Points all of whose projections are occupied, but that no ray has seen."""
    epoch = mapped.publish()
    hits = world().hits
    occupied = [
        {tuple(cell) for cell in np.floor(hits[:, axes] / 0.2).astype(int).tolist()}
        for axes in ([0, 1], [0, 2], [1, 2])
    ]
    rng = np.random.default_rng(1)
    cells = np.floor(rng.uniform(hits.min(axis=0), hits.max(axis=0), (400_000, 3)) / 0.2)
    ghosts = np.array(
        [
            (x, y, z)
            for x, y, z in cells.astype(int).tolist()
            if (x, y) in occupied[0] and (x, z) in occupied[1] and (y, z) in occupied[2]
        ],
    )
    centres = (ghosts + 0.5) * 0.2
    hidden = centres[world().scene.is_inside_house(centres, 0.5)]
    assert len(hidden) > 20, "the scene has ghosts"
    assert (epoch.status(hidden) == Status.UNKNOWN).mean() > 0.98


def test_a_place_left_behind_is_not_forgotten() -> None:
    chosen = settings(pool_bytes=75_000 * RAY_BYTES, samples_per_ray=10.0)
    here = world(3)
    mapper = settled_mapper(chosen, here)
    before = surface_error(mapper.publish(), here)
    for scan in world(14, 1.5).scans[6:]:
        take_in(mapper, scan)
        for _ in range(10):
            mapper.train()
    settle(mapper)
    assert mapper.regions.all.rays_kept <= 75_000
    assert surface_error(mapper.publish(), here) < before + 0.006
