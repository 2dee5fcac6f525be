"""Whoever receives something works at it, and another receives what comes meanwhile."""

import queue
import threading
import time

from support.servers import WAIT_S
from triquad_server.net.receivers import Receivers

_END = object()


class Channel:
    """What several threads may iterate over at the same time, as over those of Zenoh."""

    def __init__(self):
        self._arrivals = queue.SimpleQueue()

    def send(self, *arrivals):
        for arrival in arrivals:
            self._arrivals.put(arrival)

    def close(self):
        self._arrivals.put(_END)

    def __iter__(self):
        while (arrival := self._arrivals.get()) is not _END:
            yield arrival
        self._arrivals.put(_END)  # for the others


def test_what_comes_is_received_however_many_are_worked_at():
    channel, go_on, begun = Channel(), threading.Event(), queue.SimpleQueue()

    def handle(arrival):
        begun.put(arrival)
        go_on.wait(WAIT_S)

    receivers = Receivers(channel, handle, name="receiver")
    channel.send(*range(20))
    assert {begun.get(timeout=WAIT_S) for _ in range(20)} == set(range(20))
    go_on.set()
    channel.close()
    receivers.join()


def test_few_threads_stay_once_the_work_is_done():
    channel, together, done = Channel(), threading.Barrier(24), queue.SimpleQueue()

    def handle(arrival):
        together.wait(WAIT_S)
        done.put(threading.current_thread())

    receivers = Receivers(channel, handle, name="receiver")
    channel.send(*range(24))
    threads = {done.get(timeout=WAIT_S) for _ in range(24)}
    assert len(threads) == 24
    until_s = time.monotonic() + WAIT_S
    while sum(thread.is_alive() for thread in threads) > 8 and time.monotonic() < until_s:
        time.sleep(0.01)
    assert sum(thread.is_alive() for thread in threads) <= 8
    channel.close()
    receivers.join()
    assert not any(thread.is_alive() for thread in threads)


def test_who_joins_waits_for_what_is_worked_at():
    channel, go_on, done = Channel(), threading.Event(), []

    def handle(arrival):
        go_on.wait(WAIT_S)
        done.append(arrival)

    receivers = Receivers(channel, handle, name="receiver")
    channel.send("only")
    channel.close()
    joined = threading.Thread(target=receivers.join)
    joined.start()
    go_on.set()
    joined.join(WAIT_S)
    assert done == ["only"]
