import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.compiled_lattice import CompiledLattice
from triquad_map.composition.region_lattice import Lattice, RegionLattice

FIELD = FieldSettings(depth=8)
REGIONS = [(0, 0, 0), (1, 0, 0), (-1, 2, 0), (3, 3, -1)]
LATTICES = RegionLattice(FIELD, REGIONS), CompiledLattice(FIELD, REGIONS)
PITCH_M = FIELD.region_pitch_m


def owners_of(lattice: Lattice, points: np.ndarray) -> list[int]:
    """The number of the region that owns each point, -1 where none does."""
    found = np.full(len(points), -1)
    for owned in lattice.owners(points).groups:
        assert (found[owned.points] == -1).all(), "each point is in one group"
        found[owned.points] = owned.region
    return found.tolist()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3000))
def test_every_point_is_in_the_group_of_the_nearest_region(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2 * PITCH_M, 4 * PITCH_M, (count, 3))
    expected = [
        REGIONS.index(cell) if cell in REGIONS else -1
        for cell in map(tuple, np.floor(points / PITCH_M + 0.5).astype(int).tolist())
    ]
    for lattice in LATTICES:
        assert owners_of(lattice, points) == expected
    shared = [lattice.owners(points).shared for lattice in LATTICES]
    np.testing.assert_array_equal(*shared)


@pytest.mark.parametrize("lattice", LATTICES)
def test_points_near_others_are_shared(lattice: Lattice) -> None:
    half = FIELD.region_side_m / 2
    core = half - FIELD.overlap_m
    points = np.array([[core - 0.01, 0, 0], [core + 0.01, 0, 0], [0, -core - 0.01, 0], [0, 0, 0]])
    assert lattice.owners(points).shared.tolist() == [False, True, True, False]


@pytest.mark.parametrize("lattice", LATTICES)
def test_what_is_no_place_has_no_owner(lattice: Lattice) -> None:
    one_axis = np.eye(3, dtype=bool)
    bad = (np.nan, np.inf, -np.inf, 1e300, -1e12)
    nowhere = np.concatenate([np.where(one_axis, value, 0.0) for value in bad])
    owners = lattice.owners(nowhere)
    assert not owners.shared.any()
    assert owners.groups == []


@pytest.mark.parametrize("kind", [RegionLattice, CompiledLattice])
def test_a_map_without_regions_owns_nothing(kind: type[Lattice]) -> None:
    assert kind(FIELD, []).owners(np.zeros((5, 3))).groups == []  # type: ignore[call-arg]
