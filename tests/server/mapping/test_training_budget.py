"""A region's budget of training, and its share of that of the map."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_server.mapping.live_regions import FairShare
from triquad_server.mapping.region_training import TrainingBudget
from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.settings import TrainingSettings

SETTINGS = TrainingSettings(samples_per_ray=10.0, fresh_share=0.5)


def budget_of(rays: int, most: int = 10**9) -> TrainingBudget:
    budget = TrainingBudget(SETTINGS)
    budget.limit(most)
    budget.add(rays)
    return budget


def test_what_is_gone_is_unlearnt_while_there_is_more_to_learn_and_wakes_no_settled_map() -> None:
    budget = budget_of(100)
    budget.add_samples(50)
    assert budget.samples == 1050
    budget.samples = 0
    budget.add_samples(50)
    assert budget.samples == 0


TRAINING = TrainingSettings(rays_per_voxel=4.0, pool_bytes=100_000 * RAY_BYTES)


def test_each_voxel_has_as_many_rays_and_owes_as_much_however_large_the_map_is() -> None:
    small, large = FairShare.of(50, TRAINING), FairShare.of(20_000, TRAINING)
    assert small == large
    assert 3.6 < large.rays <= 4.0
    assert large.samples == 80.0
    assert large.rays_share == 1.0


def test_where_memory_has_no_room_each_voxel_has_less_and_this_is_told() -> None:
    share = FairShare.of(50_000, TRAINING)
    assert share.rays_share == pytest.approx(0.5)
    assert 1.8 < share.rays <= 2.0
    assert share.samples == 80.0


@given(st.integers(0, 2**40))
def test_all_rays_together_fit_into_memory_at_any_size(voxels: int) -> None:
    share = FairShare.of(voxels, TRAINING)
    assert share.rays * voxels * RAY_BYTES <= TRAINING.pool_bytes * (1 + 1e-9)
    assert 0 < share.rays_share <= 1


def test_the_rate_begins_high_and_ends_low_however_little_may_be_learnt() -> None:
    training = TrainingSettings(rays_per_voxel=2.0)
    share = FairShare.of(500, training)
    rays = int(share.rays * 500)
    budget = TrainingBudget(training)
    budget.limit(int(share.samples * 500))
    budget.add(10 * rays)
    first = budget.next_step(100, kept_rays=rays)
    assert first.learning_rate == training.learning_rate
    while budget.samples > 1000:
        budget.spend(budget.next_step(100, kept_rays=rays))
    last = budget.next_step(100, kept_rays=rays)
    assert last.learning_rate < 0.2 * training.learning_rate
