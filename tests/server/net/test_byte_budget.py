from triquad_server.net.byte_budget import ByteBudget

MOST_BYTES, SMALL_BYTES = 64_000_000, 262_144


def test_large_ones_share_it_and_small_ones_always_go():
    budget = ByteBudget(MOST_BYTES, small=SMALL_BYTES)
    assert budget.take(MOST_BYTES // 2)
    assert budget.take(MOST_BYTES // 2)
    assert not budget.take(SMALL_BYTES + 1)
    assert budget.take(SMALL_BYTES)
    budget.give_back(SMALL_BYTES)
    budget.give_back(MOST_BYTES // 2)
    assert budget.take(SMALL_BYTES + 1)


def test_a_single_one_may_be_larger_than_all_may_be_together():
    budget = ByteBudget(MOST_BYTES, small=SMALL_BYTES)
    assert budget.take(2 * MOST_BYTES)
    assert not budget.take(SMALL_BYTES + 1)
    budget.give_back(2 * MOST_BYTES)
    assert budget.take(2 * MOST_BYTES)
