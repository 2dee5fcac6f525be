import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.clock import Clock
from support.servers import WAIT_S
from triquad_format.errors import RefusedError
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.team import in_one
from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.settings import ServiceSettings


def epoch(number):
    return Epoch("lab", number, FieldSettings(), (), in_one)


def history(kept, pinned=0, pin_s=30.0, clock=None):
    kept_for = ServiceSettings(epochs_kept=kept, epochs_pinned=pinned, pin_s=pin_s)
    return EpochHistory(epoch(1), kept_for, clock or Clock())


def is_gone(epochs, number):
    try:
        found = epochs.get(number)
    except RefusedError as error:
        return error.code == "epoch_gone"
    assert found.number == number  # never another one
    return False


def test_an_epoch_stays_while_it_is_worked_on_and_for_the_parts_that_follow():
    epochs = history(kept=1, pinned=1)
    with epochs.view(0) as worked_on:
        for number in range(2, 6):
            epochs.add(epoch(number))
    epochs.add(epoch(6))
    assert epochs.get(1) is worked_on
    with pytest.raises(RefusedError, match="epoch_gone"):
        epochs.get(5)


def test_older_epochs_that_nobody_asked_for_go():
    epochs = history(kept=2, pinned=8)
    for number in (2, 3):
        epochs.get(0)
        epochs.add(epoch(number))
    with pytest.raises(RefusedError, match=r"epoch 1 is not kept; kept are \[2, 3\]") as caught:
        epochs.get(1)
    assert caught.value.code == "epoch_gone"
    with pytest.raises(RefusedError, match="there is no epoch 4 yet: the newest is 3") as caught:
        epochs.get(4)
    assert caught.value.code == "epoch_gone"


@pytest.mark.parametrize("by_view", [False, True])
def test_who_asks_for_an_epoch_by_number_has_the_others_let_go(by_view):
    clock = Clock()
    epochs = history(kept=4, pinned=1, clock=clock)
    for number in range(2, 5):
        epochs.add(epoch(number))
    clock.now_s += 10 * ServiceSettings().publish_period_s + 1
    if by_view:
        with epochs.view(2):
            pass
    else:
        epochs.get(2)
    assert [kept.number for kept in epochs.kept().epochs] == [2, 4]


class LargeEpoch(Epoch):
    """One with memory of its own, and some that all share."""

    buffers: dict[int, int] = {}


def large(number, size):
    made = LargeEpoch("lab", number, FieldSettings(), (), in_one)
    made.buffers = {number: size, 10**6: 500}
    return made


def test_older_epochs_stay_while_they_fit_in_their_memory_and_first_those_asked_for():
    kept_for = ServiceSettings(epochs_kept=4, epochs_pinned=8)
    epochs = EpochHistory(large(1, 100), kept_for, Clock(), older_bytes=lambda: 400)
    for number in range(2, 10):
        epochs.add(large(number, 100))
    assert [one.number for one in epochs.kept().epochs] == [6, 7, 8, 9]
    for number in (7, 6):
        epochs.get(number)
    for number in range(10, 14):
        epochs.add(large(number, 100))
    assert [one.number for one in epochs.kept().epochs] == [6, 7, 11, 12, 13]
    epochs.add(large(14, 10_000))
    epochs.add(large(15, 100))
    assert [one.number for one in epochs.kept().epochs] == [6, 7, 12, 13, 15]


def test_training_waits_while_an_epoch_is_asked_but_not_for_ever():
    epochs, asked, answered = history(kept=1), threading.Event(), threading.Event()

    def ask():
        with epochs.view(0):
            asked.set()
            answered.wait(WAIT_S)

    with ThreadPoolExecutor(1) as threads:
        threads.submit(ask)
        assert asked.wait(WAIT_S)
        epochs.give_way(0.0)  # returns, however long it is asked
        giving = threading.Thread(target=epochs.give_way, args=(WAIT_S,))
        giving.start()
        assert giving.is_alive()
        answered.set()
        giving.join(WAIT_S)
        assert not giving.is_alive()


def test_once_no_epoch_follows_only_the_newest_and_those_asked_for_stay():
    clock = Clock()
    epochs = history(kept=4, pinned=1, clock=clock)
    for number in range(2, 6):
        epochs.add(epoch(number))
    epochs.remove_expired()
    assert [kept.number for kept in epochs.kept().epochs] == [2, 3, 4, 5]
    epochs.get(3)
    clock.now_s += 10 * ServiceSettings().publish_period_s + 1
    epochs.remove_expired()
    assert [kept.number for kept in epochs.kept().epochs] == [3, 5]


DEEDS = st.one_of(
    st.just("publish"),
    st.tuples(st.just("ask"), st.integers(0, 12)),  # so many epochs back
    st.tuples(st.just("wait"), st.sampled_from([0.5, 7.0, 10.0, 11.0])),
)


@given(st.integers(1, 4), st.integers(0, 4), st.lists(DEEDS, max_size=60))
def test_whatever_is_asked_when_an_epoch_goes_only_where_it_may(kept, pinned, deeds):
    pin_s = 10.0
    clock = Clock()
    epochs = history(kept, pinned, pin_s, clock)
    newest, published = 1, clock.now_s
    alone = 1  # the newest when it last was for long
    asked: dict[int, float] = {}  # in the order of asking
    for deed in deeds:
        if deed == "publish":
            newest += 1
            published = clock.now_s
            epochs.add(epoch(newest))
        elif deed[0] == "wait":
            clock.now_s += deed[1]
            if clock.now_s - published > 10 * ServiceSettings().publish_period_s:
                alone = newest
        else:
            number = max(1, newest - deed[1])
            if is_gone(epochs, number):
                assert number <= newest - kept or number < alone
                expired = clock.now_s - asked.get(number, -1e9) > pin_s
                alive = [other for other, at in asked.items() if clock.now_s - at <= pin_s]
                assert expired or len(alive) > pinned
            else:
                asked.pop(number, None)
                asked[number] = clock.now_s
        assert epochs.get(0) is epochs.newest
        assert epochs.newest.number == newest


@given(st.integers(1, 4), st.integers(0, 4), st.integers(5, 30), st.data())
def test_no_more_stay_than_may(kept, pinned, count, data):
    epochs = history(kept, pinned)
    for number in range(2, count):
        epochs.get(number - 1)
        epochs.add(epoch(number))
        back = data.draw(st.integers(0, 6))
        is_gone(epochs, max(1, number - back))
    assert len(epochs.kept().epochs) == min(count - 1, kept + pinned)
