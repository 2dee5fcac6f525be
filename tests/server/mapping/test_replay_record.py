"""What a checkpoint holds of the rays that are kept: a little coarser than they are."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial import cKDTree
from triquad_format.records import replay_rays
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.team import Team
from triquad_server.mapping.replay.ray_table import COLUMNS, NO_ORIGIN, VALUE, RayTable
from triquad_server.mapping.replay.replay_record import recorded_rays, restored_rays

FIELD = FieldSettings(depth=12)  # 819 m: all rays but one end in the cube
RAYS = 20_000
ON_FLOOR = slice(5_000)  # the others end alone, and no normal is told there
UNTOLD = slice(RAYS - 300, RAYS)  # of these: the field told their slopes no more than a normal did
STEP_M = FIELD.leaf_m / replay_rays.STEPS


@pytest.fixture(scope="module")
def team() -> Iterator[Team]:
    team = Team("test")
    yield team
    team.close()


def table() -> RayTable:
    """Rays to a floor and to single points; a sample; and one that ends too far."""
    rng = np.random.default_rng(0)
    rows = rng.uniform(-300, 300, (RAYS, COLUMNS)).astype(np.float32)
    rows[ON_FLOOR, :2] = rng.uniform(0, 8, (5_000, 2))
    rows[ON_FLOOR, 2] = rng.normal(0.05, 0.01, 5_000)
    origin_of = rng.integers(2, size=RAYS).astype(np.int32)
    origins = np.array([[4, 4, 2], [20, -9, 7]], np.float32)
    ways = rows[:, :3] - origins[origin_of]
    rows[:, VALUE] = -rng.uniform(0.05, 0.99, RAYS)
    rows[ON_FLOOR, VALUE] = np.abs(ways[ON_FLOOR, 2]) / np.linalg.norm(ways[ON_FLOOR], axis=1)
    rows[UNTOLD, VALUE] = -1.0
    rows[6_000] = (1, 2, 3, 0.5)
    origin_of[6_000] = NO_ORIGIN
    rows[6_001, 0] = 3 * FIELD.region_side_m
    return RayTable(rows, origin_of, origins)


def both(kept: RayTable, team: Team) -> tuple[np.ndarray, np.ndarray]:
    """Rays [N, COLUMNS + 1] with the first numbers of their origins: before, and read back."""
    rays, others = recorded_rays(kept, FIELD)
    assert others.tolist() == [6_000, 6_001]
    again = restored_rays(rays, FIELD, team)
    before = RayTable(*(np.delete(part, others, axis=0) for part in kept[:2]), kept.origins)
    return with_origins(before), matched(with_origins(before), with_origins(again))


def with_origins(kept: RayTable) -> np.ndarray:
    return np.column_stack([kept.rows, kept.origins[kept.origin_of][:, 0]])


def matched(before: np.ndarray, again: np.ndarray) -> np.ndarray:
    """Each ray that was read back beside the one that it was: the nearest from its origin."""
    apart = np.eye(3)[1] * 1e4  # of those with different origins
    trees = [rays[:, :3] + (rays[:, 4:] > 10) * apart for rays in (before, again)]
    off_m, rows = cKDTree(trees[1]).query(trees[0])
    assert off_m.max() < 4 * STEP_M
    return again[rows]


def test_ends_are_read_back_to_a_few_millimetres(team: Team) -> None:
    before, again = both(table(), team)
    assert len(again) == RAYS - 2
    off = again[5_000:, :3] - before[5_000:, :3]
    assert np.abs(off).max() < 1.6 * STEP_M
    assert off.mean(axis=0) == pytest.approx([0, 0, 0], abs=0.03 * STEP_M)
    assert np.array_equal(again[:, 4], before[:, 4])


def test_the_ends_around_tell_the_slopes_again(team: Team) -> None:
    before, again = both(table(), team)
    told = again[ON_FLOOR, VALUE] > 0
    assert told.mean() > 0.99  # not where single points stand out
    off = (again[ON_FLOOR, VALUE] - before[ON_FLOOR, VALUE])[told]
    assert np.quantile(np.abs(off), 0.95) < 0.07
    assert off.mean() == pytest.approx(0, abs=0.01)


def test_slopes_that_the_field_told_are_read_back_to_hundredths(team: Team) -> None:
    before, again = both(table(), team)
    told = before[:, VALUE] > -1
    told[ON_FLOOR] = False
    assert (again[told, VALUE] < 0).all()
    slopes = again[told, VALUE] - before[told, VALUE]
    assert np.abs(slopes).max() < 0.02
    assert slopes.mean() == pytest.approx(0, abs=0.002)
    assert (again[before[:, VALUE] == -1, VALUE] == -1).all()
