"""Surfels follow the field and the evidence, as if they were always made again."""

import numpy as np
import pytest
from support.maps import small_world
from support.maps.seen_scans import see
from triquad_map.compiled.team import in_one
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting
from triquad_map.field.frozen_field import field_samples
from triquad_map.surface import FieldValues, SurfelKind, Surfels, fit_surfels
from triquad_map.surfels.surfel_map import first_surfels
from triquad_map.surfels.surfel_search import no_surfels
from triquad_server.mapping.mapper import Mapper

SIDE = 64


def plane(normal, height):
    """The exact field of a half space, in voxels."""

    def sample(points):
        values = points @ normal - height
        return FieldValues(values.astype(np.float32), np.tile(normal, (len(points), 1)))

    return sample


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, 0.8), (0.267, 0.535, 0.802)])
def test_a_disc_lies_where_the_field_is_zero(normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    voxels = np.array([[30, 30, 30]])
    field = plane(normal, float(voxels[0] @ normal) + 0.6 * normal.sum())
    surfels = fit_surfels(voxels, field, seen(False))
    assert surfels.kinds[0] == SurfelKind.DISC
    point = voxels[0] + 0.5 + surfels.offsets[0]
    assert abs(field(point[None]).sdf[0]) < 1e-4
    np.testing.assert_allclose(surfels.normals[0], normal, atol=1e-5)


def seen(is_seen):
    """Whether there is surface in the voxels that are asked for."""
    return lambda asked: np.full(len(asked), is_seen)


def flat(value):
    """A field that is the same everywhere."""

    def sample(points):
        return FieldValues(np.full(len(points), value, np.float32), np.zeros((len(points), 3)))

    return sample


def test_where_the_field_shows_nothing_a_point_stands_for_what_was_seen():
    surfels = fit_surfels(np.array([[5, 6, 7]]), flat(2.0), seen(False))
    assert surfels.kinds[0] == SurfelKind.POINT
    np.testing.assert_array_equal(surfels.offsets[0], 0)


def by_rays(kind, offset):
    """What rays have shown of all voxels: a floor that lies so far above their middles."""

    def shown(voxels, _since=0):
        offsets, normals = np.zeros((2, len(voxels), 3), np.float32)
        offsets[:, 2], normals[:, 2] = offset, 1
        return Surfels(offsets, normals, np.full(len(voxels), kind, np.uint8))

    return shown


@pytest.mark.parametrize("kind", [SurfelKind.RAY_DISC, SurfelKind.RAY_POINT])
@pytest.mark.parametrize(
    ("field", "seen_beside"),
    [
        (plane(np.array([0.0, 0, 1]), 29.7), True),  # its surface is next door,
        (plane(np.array([0.0, 0, 1]), 20.0), True),  # far below,
        (flat(0.0), False),  # or nowhere
    ],
)
def test_where_the_field_has_not_learnt_what_rays_saw_they_count(kind, field, seen_beside):
    surfels = fit_surfels(np.array([[30, 30, 30]]), field, seen(seen_beside), by_rays(kind, 0.3))
    assert surfels.kinds[0] == kind
    np.testing.assert_allclose(surfels.offsets[0], (0, 0, 0.3), atol=1e-6)


def test_the_field_takes_over_once_it_has_learnt_the_surface():
    voxels, shown = np.array([[30, 30, 30]]), by_rays(SurfelKind.RAY_DISC, 0.3)
    field = plane(np.array([0.0, 0, 1]), 30.75)
    surfels = fit_surfels(voxels, field, seen(True), shown)
    assert surfels.kinds[0] == SurfelKind.DISC
    next_door = plane(np.array([0.0, 0, 1]), 31.1)  # and rays ended a little below it, too
    shown = by_rays(SurfelKind.RAY_DISC, 0.45)
    surfels = fit_surfels(voxels, next_door, seen(True), shown)
    assert surfels.kinds[0] == SurfelKind.NONE


def seen_by_rays(ends):
    """Evidence of one scan from above."""
    evidence = LiveEvidence(SIDE)
    see(evidence, ends, Sighting(np.array([32.0, 32, 60]), 0.2, stamp_s=1, scan=1))
    return evidence


def test_rays_show_a_disc_that_faces_the_sensor():
    ends = np.array([[30.3, 30.4, 30.2], [30.5, 30.6, 30.2]])
    around = ends[0] + np.stack([*np.meshgrid([-1, 0, 1], [-1, 0, 1]), np.zeros((3, 3))], -1)
    around = np.delete(around.reshape(-1, 3), 4, axis=0)
    evidence = seen_by_rays(np.concatenate([ends, around]))
    shown = evidence.ray_surfels(np.array([[30, 30, 30], [9, 9, 9]]), since=1)
    assert shown.kinds.tolist() == [SurfelKind.RAY_DISC, SurfelKind.NONE]
    assert evidence.ray_surfels(np.array([[30, 30, 30]]), since=2).kinds[0] == SurfelKind.NONE
    np.testing.assert_allclose(shown.offsets[0], ends.mean(axis=0) - 30.5, atol=1e-5)
    np.testing.assert_allclose(shown.normals[0], (0, 0, 1))


def test_the_ends_around_lie_on_a_plane_or_do_not():
    rng = np.random.default_rng(4)
    slope = np.array([0.6, 0, 0.8])
    ends = rng.uniform(28, 34, (400, 3))
    ends[:, 2] = 30.5 - (ends[:, 0] - 30.5) * 0.75
    shown = seen_by_rays(ends).ray_surfels(np.array([[30, 30, 30]]), since=1)
    assert shown.kinds[0] == SurfelKind.RAY_DISC
    np.testing.assert_allclose(shown.normals[0], slope, atol=0.05)
    scattered = rng.uniform(28, 34, (400, 3))
    shown = seen_by_rays(scattered).ray_surfels(np.array([[30, 30, 30]]), since=1)
    assert shown.kinds[0] == SurfelKind.RAY_POINT


def nearest(surfels, points):
    found = no_surfels(np.full(len(points), 40.0))
    surfels.find_nearest(points, found)
    return found


def random_evidence(rng, count):
    evidence = LiveEvidence(SIDE)
    evidence.mark("surface", rng.uniform((0, 0, 28), (SIDE, SIDE, 33), (count, 3)))
    return evidence


def test_surfels_kept_up_to_date_are_those_made_anew():
    rng = np.random.default_rng(0)
    evidence = random_evidence(rng, 300)
    before, after = (plane(np.array([0.6, 0, 0.8]), height) for height in (43.0, 43.3))
    surfels = first_surfels(evidence.freeze(), before, 1)
    evidence.mark("surface", rng.uniform((0, 0, 25), (SIDE, SIDE, 35), (200, 3)))
    evidence.clear(np.array([0.0, 0, 0]), np.array([20.0, 20, 64]))
    kept = surfels.updated(evidence.freeze(), after, 2, None)
    anew = first_surfels(evidence.freeze(), after, 2)
    assert len(kept) == len(anew) > 300
    points = rng.uniform(0, SIDE, (500, 3))
    for mine, wanted in zip(nearest(kept, points), nearest(anew, points), strict=True):
        np.testing.assert_array_equal(mine, wanted)


def test_a_bounded_update_fits_what_is_new_and_gets_to_the_rest_in_turn():
    rng = np.random.default_rng(1)
    evidence = random_evidence(rng, 400)
    low, high = (plane(np.array([0.0, 0, 1]), height) for height in (29.5, 31.5))
    surfels = first_surfels(evidence.freeze(), low, 1)
    new = np.array([[10.5, 10.5, 50.5]])
    evidence.mark("surface", new)
    points = np.concatenate([new + (0, 0, 3.0), rng.uniform((0, 0, 36), (SIDE, SIDE, 40), (50, 3))])
    wanted = first_surfels(evidence.freeze(), high, 1)
    rounds = 0
    while not np.array_equal(nearest(surfels, points).closest, nearest(wanted, points).closest):
        surfels = surfels.updated(evidence.freeze(), high, 2 + rounds, 100)
        rounds += 1
        np.testing.assert_allclose(nearest(surfels, points[:1]).distances, 3.0)
        assert rounds < 10
    assert rounds > 1


def surfels_of(region, mapper_settings):
    samples = field_samples(region.engine, mapper_settings, in_one)  # type: ignore[arg-type]
    return first_surfels(region.evidence, samples, 1)


def test_a_settled_map_answers_as_if_fitted_anew():
    chosen = small_world.settings()
    drive = small_world.world(3)
    mapper = Mapper("test", chosen, "cpu")
    for scan in drive.scans:
        mapper.ingest(scan.points, scan.world_from_sensor)
        mapper.train()
        mapper.publish()
    small_world.settle(mapper)
    epoch = mapper.publish()
    for region in epoch.frozen_regions:
        found, expected = region.surfels.surfels, surfels_of(region, chosen.field).surfels
        # A few new rays owe no training: what they show is all that is known there.
        is_learnt = found.kinds < SurfelKind.RAY_DISC
        assert is_learnt.all() or len(is_learnt) < 100
        for name, values in vars(found).items():
            np.testing.assert_array_equal(values[is_learnt], getattr(expected, name)[is_learnt])
