"""Each point is answered for by the region whose centre is nearest; fields are blended between."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.status import Status
from triquad_map.composition.field_view import FieldView
from triquad_map.field.frozen_field import in_grid
from triquad_map.surface import FieldValues

FIELD = FieldSettings(depth=8)
REGIONS = [(0, 0, 0), (1, 0, 0), (-1, 2, 0), (3, 3, -1)]
PITCH_M = FIELD.region_pitch_m


class NumberedRegion:
    """A region whose field and status are its number everywhere."""

    def __init__(self, number: int, index: RegionIndex) -> None:
        self.index = index
        self.centre = FIELD.region_centre(index)
        self.field = self.evidence = self
        self.number = number

    def evaluate(self, points: np.ndarray, gradient: bool) -> FieldValues:
        slopes = np.zeros((len(points) if gradient else 0, 3), np.float32)
        return FieldValues(np.full(len(points), self.number, np.float32), slopes)

    def evaluate_in_grid(self, axes: np.ndarray, points: np.ndarray) -> np.ndarray:
        return self.evaluate(in_grid(axes, points), gradient=False).sdf

    def status(self, voxels: np.ndarray, reach: float) -> np.ndarray:
        return np.full(len(voxels), self.number, np.uint8)

    def surface_in_grid(self, axes: Sequence[np.ndarray], reach: float) -> np.ndarray:
        x, y, z = np.ix_(*(np.floor(axis).astype(np.int64) for axis in axes))
        return np.asarray((x + y + z + self.number) % 3 == 0)

    def has_surface(self, point: np.ndarray) -> bool:
        """Whether the grid has, at a point of the map frame."""
        voxel = np.floor(FIELD.leaf_coordinates(point - self.centre)).astype(np.int64)
        return (int(voxel.sum()) + self.number) % 3 == 0


def view_of(regions: list[RegionIndex]) -> FieldView:
    numbered = [NumberedRegion(number, index) for number, index in enumerate(regions, start=10)]
    return FieldView(FIELD, numbered)  # type: ignore[arg-type]


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3000), st.floats(0.01, 3.0))
def test_every_point_has_the_status_that_the_nearest_region_gives(
    seed: int, count: int, spread: float
) -> None:
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-PITCH_M, 3 * PITCH_M, 3)
    points = middle + rng.uniform(-spread * PITCH_M, spread * PITCH_M, (count, 3))
    cells = map(tuple, np.floor(points / PITCH_M + 0.5).astype(int).tolist())
    expected = [10 + REGIONS.index(c) if c in REGIONS else Status.UNKNOWN for c in cells]
    view = view_of(REGIONS)
    assert view.status(points).tolist() == expected
    answer = view.query(points, gradient=True)
    assert answer.status.tolist() == expected
    owned = np.array(expected) >= 10
    assert np.isfinite(answer.sdf[owned]).all()


def random_axes(rng: np.random.Generator, spread: float) -> np.ndarray:
    """The coordinates of a grid, which lies in one region or in several."""
    low = rng.uniform(-PITCH_M, 3 * PITCH_M, 3)
    return low[:, None] + np.arange(6) * rng.uniform(0.1, 1.0) * spread * PITCH_M


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.floats(0.001, 1.0))
def test_the_field_in_a_grid_is_that_at_its_points(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    axes, points = random_axes(rng, spread), rng.integers(0, 6, (50, 3))
    view = view_of(REGIONS)
    found = view.distances_in_grid(axes, points)
    np.testing.assert_allclose(found, view.distances(in_grid(axes, points)))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 1.0))
def test_the_region_that_owns_a_point_of_a_grid_answers_for_it(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    axes = random_axes(rng, spread)
    surface = view_of(REGIONS).surface_in_grid(axes, 0.1)
    for at in np.ndindex(surface.shape):
        point = np.array([axis[i] for axis, i in zip(axes, at, strict=True)])
        owner = tuple(np.floor(point / PITCH_M + 0.5).astype(int).tolist())
        number = 10 + REGIONS.index(owner) if owner in REGIONS else None
        expected = number is not None and NumberedRegion(number, owner).has_surface(point)
        assert surface[at] == expected


def test_the_field_is_blended_where_regions_overlap_and_only_there() -> None:
    core_m = FIELD.region_side_m / 2 - FIELD.overlap_m
    inner, outer, middle = core_m - 0.01, core_m + 0.01, PITCH_M / 2
    points = np.array([[0, 0, 0], [inner, 0, 0], [outer, 0, 0], [middle, 0, 0], [0, -outer, 0]])
    sdf = view_of(REGIONS).query(points).sdf
    assert sdf[[0, 1, 4]].tolist() == [10, 10, 10]
    assert 10 < sdf[2] < 10.5
    assert sdf[3] == 10.5


def test_what_is_no_place_has_no_owner() -> None:
    one_axis = np.eye(3, dtype=bool)
    bad = (np.nan, np.inf, -np.inf, 1e300, -1e12)
    nowhere = np.concatenate([np.where(one_axis, value, 0.0) for value in bad])
    for points in (nowhere, nowhere[:1]):
        answer = view_of(REGIONS).query(np.concatenate([points, np.zeros((1, 3))]))
        assert answer.status.tolist() == [Status.UNKNOWN] * len(points) + [10]
        assert np.isnan(answer.sdf[:-1]).all()
