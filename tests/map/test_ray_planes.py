"""What rays have shown counts until the field has learnt it: fast code against plain sums."""

from functools import partial

import numpy as np
from support.maps.seen_scans import see
from support.maps.small_world import mapper_of, world
from triquad_format.records.field_settings import FieldSettings
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting
from triquad_map.surface import FieldValues, SurfelKind, level_confidence
from triquad_map.surfels.ray_planes import put_planes
from triquad_map.surfels.surfel_map import first_surfels

FIELD = FieldSettings(depth=6)
SIDE = 1 << FIELD.depth


def learnt_on_one_side(points):
    """A field that knows the floor at a height of 30.5 voxels, but only where x is below 30."""
    right = points[:, 0] > 30
    values = np.where(right, 2.0, points[:, 2] - 30.5).astype(np.float32)
    gradients = np.where(right[:, None], 0.0, (0.0, 0, 1)).astype(np.float32)
    return FieldValues(values, gradients)


def test_planes_are_summed_as_told():
    rng = np.random.default_rng(5)
    evidence = LiveEvidence(SIDE)
    ends = rng.uniform((20, 20, 30.4), (44, 44, 30.6), (4000, 3))
    ends[:300, 2] += rng.uniform(-4, 4, 300)
    see(evidence, ends, Sighting(np.array([32.0, 32, 60]), 0.2, stamp_s=1, scan=1))
    frozen = evidence.freeze()
    surfels = first_surfels(frozen, learnt_on_one_side, 1, partial(evidence.ray_surfels, since=1))
    kinds = surfels.surfels.kinds
    assert {SurfelKind.DISC, SurfelKind.RAY_DISC, SurfelKind.RAY_POINT} <= set(kinds.tolist())
    points = rng.uniform((19, 19, 28), (45, 45, 33), (3000, 3))
    local = FIELD.offsets(points).astype(np.float32)
    sdf, gradients = np.full(3000, 7.0, np.float32), np.full((3000, 3), 5.0, np.float32)
    middle = float(1 << FIELD.depth - 1)
    put_planes(local, FIELD.leaf_m, middle, surfels.planes, sdf, gradients)

    places = surfels.voxels() + 0.5 + surfels.surfels.offsets
    away = points[:, None] - places
    near = np.maximum(1 - (away**2).sum(axis=2) / 1.5**2, 0) ** 4
    counts = (kinds == SurfelKind.DISC) | (kinds >= SurfelKind.RAY_DISC)
    weights = near * np.where(counts, level_confidence()[frozen.levels], 0)
    unlearnt = (weights * (kinds >= SurfelKind.RAY_DISC)).sum(axis=1)
    total = np.maximum(weights.sum(axis=1), 1e-12)
    heights = (away * surfels.surfels.normals).sum(axis=2)
    share = unlearnt / total
    mean = (weights * heights).sum(axis=1) / total * FIELD.leaf_m
    normals = weights @ surfels.surfels.normals / total[:, None]
    np.testing.assert_allclose(sdf, (1 - share) * 7 + share * mean, atol=1e-4)
    wanted = (1 - share)[:, None] * 5 + share[:, None] * normals
    np.testing.assert_allclose(gradients, wanted, atol=1e-4)
    assert 0.2 < (share == 1).mean() < 0.9


def test_a_map_is_right_before_it_has_learnt_anything():
    seen = world()
    epoch = mapper_of(*seen.scans).publish()
    rng = np.random.default_rng(0)
    hits = seen.hits[rng.choice(len(seen.hits), 4000)]
    normals = seen.scene.gradient(hits)
    for height_m in (-0.05, 0.0, 0.05, 0.1):
        points = hits + height_m * normals
        answer = epoch.query(points, gradient=True)
        error_m = np.abs(answer.sdf - seen.scene.sdf(points))
        assert np.median(error_m) < 0.02
        assert np.quantile(error_m, 0.9) < 0.06
    off = np.rad2deg(np.arccos(np.clip((answer.gradient * normals).sum(axis=1), -1, 1)))
    assert np.median(off) < 5
