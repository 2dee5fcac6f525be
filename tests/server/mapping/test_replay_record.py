"""What a checkpoint holds of the rays that are kept: a little coarser than they are."""

import numpy as np
import pytest
from triquad_format.records import replay_rays
from triquad_format.records.field_settings import FieldSettings
from triquad_server.mapping.held_out import are_held_out, ends_in_steps
from triquad_server.mapping.ray_table import COLUMNS, NO_ORIGIN, VALUE, RayTable
from triquad_server.mapping.replay_record import recorded_rays, restored_rays

FIELD = FieldSettings()
RAYS = 20_000


def table() -> RayTable:
    """Rays in a region, some of whose slopes nothing told; a sample; and one that ends too far."""
    rng = np.random.default_rng(0)
    rows = rng.uniform(-300, 300, (RAYS, COLUMNS)).astype(np.float32)
    rows[:, VALUE] = rng.uniform(0.05, 1, RAYS)
    rows[:100, VALUE] = -1.0
    rows[100] = (1, 2, 3, 0.5)
    rows[101, 0] = 3 * FIELD.region_side_m
    origin_of = rng.integers(2, size=RAYS).astype(np.int32)
    origin_of[100] = NO_ORIGIN
    return RayTable(rows, origin_of, rng.uniform(-9, 9, (2, 3)).astype(np.float32))


def both(kept: RayTable) -> tuple[np.ndarray, np.ndarray]:
    """Rays [N, COLUMNS + 1] with the first numbers of their origins: before, and read back."""
    rays, others = recorded_rays(kept, FIELD)
    assert others.tolist() == [100, 101]
    again = restored_rays(rays, FIELD)
    before = RayTable(*(np.delete(part, others, axis=0) for part in kept[:2]), kept.origins)
    return tuple(in_order(part) for part in (before, again))


def in_order(kept: RayTable) -> np.ndarray:
    """By the leaf in which they end, of which each has one."""
    rows = np.column_stack([kept.rows, kept.origins[kept.origin_of][:, 0]])
    return rows[np.lexsort((ends_in_steps(kept.rows, FIELD) // replay_rays.STEPS).T)]


def test_rays_are_read_back_to_a_few_millimetres_and_hundredths_of_a_slope() -> None:
    before, again = both(table())
    assert len(again) == RAYS - 2
    step_m = FIELD.leaf_m / replay_rays.STEPS
    off = again[:, :3] - before[:, :3]
    assert np.abs(off).max() < 2.6 * step_m
    assert off.mean(axis=0) == pytest.approx([0, 0, 0], abs=0.05 * step_m)
    assert np.array_equal(again[:, 4], before[:, 4])
    known = before[:, VALUE] > 0
    assert np.array_equal(again[:, VALUE] == -1, ~known)
    slopes = again[known, VALUE] - before[known, VALUE]
    assert np.abs(slopes).max() < 0.02
    assert slopes.mean() == pytest.approx(0, abs=0.002)


def test_the_same_rays_are_held_out_when_they_are_read_back() -> None:
    before, again = both(table())
    held = are_held_out(before[:, :COLUMNS].copy(), FIELD)
    assert 300 < held.sum() < 1_000
    assert np.array_equal(are_held_out(again[:, :COLUMNS].astype(np.float32), FIELD), held)
