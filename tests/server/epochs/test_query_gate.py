"""Queries come first, and work in the background takes turns."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from triquad_server.epochs import query_gate as module
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


def test_who_wakes_up_late_is_not_held_back_again() -> None:
    gate = QueryGate()
    asked = []

    def pressure() -> float:
        if asked:  # the query woke up, and its core was busy for longer than queries may go on
            time.sleep(0.01)
        while not asked and time.monotonic() % module._PERIOD_S > 0.01:
            time.sleep(0.001)  # it comes while they are held back
        asked.append(True)
        return 1.0

    gate.hold_back_by(pressure)

    def query() -> None:
        with gate.query():
            gate.wait_for_mapping()

    thread = threading.Thread(target=query, daemon=True)
    thread.start()
    thread.join(5.0)
    assert not thread.is_alive()
