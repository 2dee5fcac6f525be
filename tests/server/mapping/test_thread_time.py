"""What a thread spends its time on, and whether it computes meanwhile."""

import threading
import time

from support import servers
from triquad_server.mapping.thread_time import Activity, Current, ThreadTime

COMPUTED_S = 0.3


def test_what_computes_for_long_is_told_from_what_waits() -> None:
    spent = ThreadTime()
    computed, released = threading.Event(), threading.Event()

    def work() -> None:
        spent.begin(Activity.COMMANDS)
        while time.thread_time() < COMPUTED_S:
            pass
        computed.set()
        released.wait(servers.WAIT_S)

    thread = threading.Thread(target=work)
    thread.start()
    assert computed.wait(servers.WAIT_S)
    first = spent.current()
    while spent.current().for_s < first.for_s + COMPUTED_S:  # it only waits now
        assert not released.wait(COMPUTED_S / 10)
    second = spent.current()
    released.set()
    thread.join()

    def computed_s(current: Current) -> float:
        return current.for_s - current.waited_s

    assert computed_s(first) > 0.9 * COMPUTED_S
    assert computed_s(second) < computed_s(first) + 0.1 * COMPUTED_S
    assert second.waited_s > first.waited_s + 0.9 * COMPUTED_S


def test_of_a_thread_that_has_not_begun_or_has_ended_all_is_waiting() -> None:
    spent = ThreadTime()
    before = spent.current()
    assert (before.activity, before.waited_s) == (Activity.IDLE, before.for_s)
    thread = threading.Thread(target=spent.begin, args=(Activity.SCANS,))
    thread.start()
    thread.join()
    current = spent.current()
    assert current.activity is Activity.SCANS
    assert 0 <= current.waited_s <= current.for_s
