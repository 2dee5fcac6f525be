"""Queries come first, and work in the background takes turns."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from triquad_server.epochs.query_gate import QueryGate

_LONG_S = 60.0


def test_steps_of_several_threads_never_meet() -> None:
    gate = QueryGate()
    alone = threading.Lock()

    def work() -> None:
        for _ in range(200):
            with gate.turn():
                assert alone.acquire(blocking=False), "another step is under way"
                alone.release()

    with ThreadPoolExecutor(4) as threads:
        for thread in [threads.submit(work) for _ in range(4)]:
            thread.result(_LONG_S)


def test_a_step_that_fails_hands_on_the_turn() -> None:
    gate = QueryGate()
    with pytest.raises(ZeroDivisionError), gate.turn():
        raise ZeroDivisionError
    with gate.turn():
        pass


def test_background_work_goes_on_however_long_a_query_takes() -> None:
    gate = QueryGate()
    with gate.query():
        gate.give_way(0.0)


def test_asked_a_short_time_ago() -> None:
    gate = QueryGate()
    assert not gate.asked_within(_LONG_S)
    with gate.query():
        assert gate.asked_within(0.0)
    assert gate.asked_within(_LONG_S)
    assert not gate.asked_within(0.0)


def test_while_mapping_is_pressed_it_gives_way_to_no_query_for_long() -> None:
    gate = QueryGate()
    answered = threading.Event()

    def ask() -> None:
        with gate.query():
            while not answered.is_set():
                gate.wait_for_mapping()

    gate.hold_back_by(lambda: 1.0)
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(ask)
        for _ in range(3):
            gate.give_way(_LONG_S)  # returns while the query is held back
        answered.set()
        asked.result(_LONG_S)


def test_what_is_held_back_is_answered_in_the_end() -> None:
    gate = QueryGate()
    gate.hold_back_by(lambda: 1.0)
    for _ in range(5):
        with gate.query():
            gate.wait_for_mapping()
    gate.hold_back_by(lambda: 0.0)
    with gate.query():
        gate.wait_for_mapping()
