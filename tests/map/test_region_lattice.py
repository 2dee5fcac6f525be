import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.region_lattice import RegionLattice

FIELD = FieldSettings(depth=8)
REGIONS = [(0, 0, 0), (1, 0, 0), (-1, 2, 0), (3, 3, -1)]
LATTICE = RegionLattice(FIELD, REGIONS)
PITCH_M = FIELD.region_pitch_m


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3000))
def test_every_point_is_in_the_group_of_the_nearest_region(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2 * PITCH_M, 4 * PITCH_M, (count, 3))
    expected = [
        REGIONS.index(cell) if cell in REGIONS else -1
        for cell in map(tuple, np.floor(points / PITCH_M + 0.5).astype(int).tolist())
    ]
    found = np.full(count, -1)
    owners = LATTICE.owners(points)
    for owned in owners.groups():
        assert (found[owned.points] == -1).all()
        found[owned.points] = owned.region
    assert found.tolist() == expected == owners.regions.tolist()


def test_points_near_others_are_shared() -> None:
    half = FIELD.region_side_m / 2
    core = half - FIELD.overlap_m
    points = np.array([[core - 0.01, 0, 0], [core + 0.01, 0, 0], [0, -core - 0.01, 0], [0, 0, 0]])
    assert LATTICE.owners(points).shared.tolist() == [False, True, True, False]


def test_what_is_no_place_has_no_owner() -> None:
    one_axis = np.eye(3, dtype=bool)
    bad = (np.nan, np.inf, -np.inf, 1e300, -1e12)
    nowhere = np.concatenate([np.where(one_axis, value, 0.0) for value in bad])
    owners = LATTICE.owners(nowhere)
    assert owners.regions.tolist() == [-1] * len(nowhere)
    assert not owners.shared.any()
    assert list(owners.groups()) == []


def test_a_map_without_regions_owns_nothing() -> None:
    owners = RegionLattice(FIELD, []).owners(np.zeros((5, 3)))
    assert owners.regions.tolist() == [-1] * 5
