from triquad_server.net.reply_memory import MOST_BYTES, SMALL_BYTES, ReplyMemory


def test_large_replies_share_the_memory_and_small_ones_always_go():
    memory = ReplyMemory()
    assert memory.take(MOST_BYTES // 2)
    assert memory.take(MOST_BYTES // 2)
    assert not memory.take(SMALL_BYTES + 1)
    assert memory.take(SMALL_BYTES)
    memory.give_back(SMALL_BYTES)
    memory.give_back(MOST_BYTES // 2)
    assert memory.take(SMALL_BYTES + 1)


def test_a_single_reply_may_be_larger_than_all_may_be_together():
    memory = ReplyMemory()
    assert memory.take(2 * MOST_BYTES)
    assert not memory.take(SMALL_BYTES + 1)
    memory.give_back(2 * MOST_BYTES)
    assert memory.take(2 * MOST_BYTES)
