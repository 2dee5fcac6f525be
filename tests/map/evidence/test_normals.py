import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.maps.seen_scans import end
from triquad_format.records.arrays import Doubles
from triquad_map.evidence.carving import Reach
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.evidence.observed import Sighting
from triquad_map.evidence.ray_surfels import normals_at

SIDE = 128
MIDDLE = np.array([64.0, 64.0, 64.0])
SENSOR = np.array([64.0, 64.0, 120.0])
NOISE = 0.05  # voxels: 1 cm of the default leaf


def plane(rng: np.random.Generator, normal: Doubles, count: int, half: float = 10.0) -> Doubles:
    """Random points [N, 3] on a noisy square through the middle."""
    axes = np.linalg.svd(normal[None])[2][1:]
    points = rng.uniform(-half, half, (count, 2)) @ axes
    return MIDDLE + points + rng.normal(0, NOISE, (count, 1)) * normal


def normals(evidence: LiveEvidence, ends: Doubles, scan: int = 1) -> Doubles:
    """Have a scan end at ``ends`` [N, 3], and return the normals there."""
    rows = end(evidence, ends, Sighting(SENSOR, 0.2, 1, scan))
    return normals_at(ends, rows, evidence.observed)


def off_degrees(found: Doubles, normal: Doubles) -> Doubles:
    return np.degrees(np.arccos(np.clip(np.abs(found @ normal), 0, 1)))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_a_noisy_plane_has_its_normal_nearly_everywhere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    found = normals(LiveEvidence(SIDE), plane(rng, normal, 4000))
    known = ~np.isnan(found[:, 0])
    assert known.mean() > 0.9
    np.testing.assert_allclose(np.linalg.norm(found[known], axis=1), 1, atol=1e-5)
    assert np.median(off_degrees(found[known], normal)) < 4


def test_ground_of_a_few_lines_is_known_once_many_scans_have_met_it() -> None:
    """Far beams draw lines that lie metres apart, others with each scan."""
    rng, evidence, up = np.random.default_rng(1), LiveEvidence(SIDE), np.array([0.0, 0.0, 1.0])
    known = []
    for scan in range(1, 17):
        x = rng.uniform(-10, 10, 2).repeat(100)
        y = np.tile(np.linspace(-10, 10, 100), 2)
        ends = MIDDLE + np.stack([x, y, rng.normal(0, NOISE, 200)], axis=1)
        found = normals(evidence, ends, scan)
        known.append(float((~np.isnan(found[:, 0])).mean()))
    assert max(known[:1]) < 0.2
    assert min(known[-4:]) > 0.8
    seen = ~np.isnan(found[:, 0])
    assert np.median(off_degrees(found[seen], up)) < 4


def test_what_lies_over_a_plane_does_not_have_its_normal() -> None:
    rng, evidence, up = np.random.default_rng(2), LiveEvidence(SIDE), np.array([0.0, 0.0, 1.0])
    ground, thing = plane(rng, up, 4000), MIDDLE + [[0.4, 0.4, 0.9]]
    found = normals(evidence, np.concatenate([ground, thing]))
    assert np.isnan(found[-1]).all()


def test_rays_that_carve_meanwhile_change_no_normal() -> None:
    """They add blocks to the index in which the ends around a voxel are found."""
    found = []
    for carves_first in (False, True):
        rng, evidence = np.random.default_rng(4), LiveEvidence(SIDE)
        for number in range(1, 4):
            ends = plane(rng, np.array([0.0, 0.6, 0.8]), 2000)
            rows = evidence.record_ends(ends, Sighting(SENSOR, 0.2, 1, number))
            search = evidence.outdated_normals(rows, since=0)
            blocks = evidence.size.blocks
            if carves_first:
                evidence.carve(SENSOR, ends, Reach(0.5, 2.5, number))
                assert evidence.size.blocks > blocks or number > 1
            search.find(0, len(search.rows))
            if not carves_first:
                evidence.carve(SENSOR, ends, Reach(0.5, 2.5, number))
            search.finish()
            found.append(normals_at(ends, rows, evidence.observed))
    np.testing.assert_array_equal(found[:3], found[3:])
    assert not np.isnan(found[-1]).all()
