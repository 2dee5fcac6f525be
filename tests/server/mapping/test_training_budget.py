"""A region's budget of training, and its share of that of the map."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.mapping.training.training_budget import FairShare, TrainingBudget
from triquad_server.settings import TrainingSettings

SETTINGS = TrainingSettings(samples_per_ray=10.0, fresh_share=0.5)
BATCH = 1000


def budget_of(rays: int, most: int = 10**9) -> TrainingBudget:
    budget = TrainingBudget(SETTINGS)
    budget.limit(most)
    budget.add(rays)
    return budget


def spend_all(budget: TrainingBudget, kept_rays: int) -> list[tuple[float, float]]:
    """The learning rates of old and of young rows in each step until nothing is owed."""
    rates = []
    while budget.samples:
        step = budget.next_step(BATCH, kept_rays)
        rates.append((step.rates.learning_rate, step.rates.young_rate))
        budget.spend(step)
    return rates


def test_a_map_of_new_rays_alone_cools_at_the_end_young_and_old_alike() -> None:
    rates = spend_all(budget_of(10_000), 10_000)
    assert len(rates) == 100
    assert all(old == young for old, young in rates)
    old = [rate for rate, _ in rates]
    assert old[0] == old[19] == SETTINGS.learning_rate
    assert old == sorted(old, reverse=True)
    assert old[-1] == pytest.approx(0.02 * SETTINGS.learning_rate)


def test_few_new_rays_beside_many_move_what_is_old_little_and_what_is_young_much() -> None:
    budget = budget_of(100_000)
    spend_all(budget, 100_000)
    budget.add(1000)
    rates = budget.next_step(BATCH, 101_000).rates
    assert rates.learning_rate == pytest.approx(0.02 * SETTINGS.learning_rate)
    assert rates.young_rate == SETTINGS.learning_rate


def test_no_more_is_owed_than_may_be_and_the_rest_is_counted() -> None:
    budget = budget_of(10_000, most=30_000)
    assert (budget.samples, budget.discarded) == (30_000, 70_000)
    budget.limit(20_000)
    assert (budget.samples, budget.discarded) == (20_000, 80_000)


def test_what_is_gone_is_unlearnt_while_there_is_more_to_learn_and_wakes_no_settled_map() -> None:
    budget = budget_of(100)
    budget.add_samples(50)
    assert budget.samples == 1050
    budget.clear()
    budget.add_samples(50)
    assert budget.samples == 0


TRAINING = TrainingSettings(
    pool_rays=10_000,
    rays_per_voxel=4.0,
    pool_bytes=100_000 * RAY_BYTES,
    max_budget_samples=500_000,
    samples_per_voxel=100.0,
)


def test_a_small_map_keeps_as_many_rays_and_owes_as_much_however_small_it_is() -> None:
    for voxels in (10, 100, 1000):
        share = FairShare.of(voxels, TRAINING)
        assert 9000 < share.rays * voxels <= 10_000
        assert share.samples * voxels == pytest.approx(500_000)
        assert share.rays_share == 1.0


def test_a_large_map_has_as_much_for_each_voxel() -> None:
    small, large = FairShare.of(5000, TRAINING), FairShare.of(20_000, TRAINING)
    assert small == large
    assert 3.6 < large.rays <= 4.0
    assert large.samples == 100.0


def test_where_memory_has_no_room_each_voxel_has_less_and_this_is_told() -> None:
    share = FairShare.of(50_000, TRAINING)
    assert share.rays_share == pytest.approx(0.5)
    assert 1.8 < share.rays <= 2.0
    assert share.samples == 100.0


@given(st.integers(0, 2**40))
def test_all_rays_together_fit_into_memory_at_any_size(voxels: int) -> None:
    share = FairShare.of(voxels, TRAINING)
    assert share.rays * voxels * RAY_BYTES <= TRAINING.pool_bytes * (1 + 1e-9)
    assert 0 < share.rays_share <= 1
