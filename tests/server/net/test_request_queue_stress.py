"""Requests that pause, rest, begin anew and fail at random: each ends once, and none stays."""

import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.servers import WAIT_S
from triquad_server.fair_queue import Owner
from triquad_server.net.request_queue import RequestQueue, SetAsideError

REQUESTS = 200  # of each of those who ask
ASKERS = 4


class DefectError(Exception):
    """What a request meets."""


class Server:
    """Works at requests in threads, as the handlers of requests do."""

    def __init__(self, seed):
        chance = random.Random(seed)
        self._seed = seed
        self._threads = ThreadPoolExecutor(100)
        self._lock = threading.Lock()
        self.ended = []
        self.queue = RequestQueue(
            lambda job: self._threads.submit(self._work, job),
            lambda: chance.random() < 0.9,
            workers=chance.choice([1, 2, 4]),
            limit=chance.choice([5, 1000]),
            limit_bytes=10**6,
        )

    def ask(self, asker):
        chance = random.Random(f"{self._seed} {asker}")
        for number in range(REQUESTS):
            owner = Owner(chance.choice(["", asker]), str(chance.randrange(3)))
            placed = self.queue.put(owner, f"{asker} {number}", chance.randrange(100))
            self._end(placed.excess)
            if placed.begun is not None:
                self._threads.submit(self._work, placed.begun)
            time.sleep(0.002 * chance.random())

    def close(self):
        self._threads.shutdown()

    def _work(self, job):
        chance = random.Random(f"{self._seed} {job.request}")
        try:
            self._answer(job, chance)
            self._end([job.request])
        except SetAsideError:
            self.queue.put_back(job)
        except DefectError:
            self._end([job.request])
        finally:
            self.queue.finish(job)

    def _answer(self, job, chance):
        for _ in range(chance.choice([0, 1, 3, 30])):
            what = chance.random()
            if what < 0.4:
                self.queue.pause(job)
            elif what < 0.7:
                self.queue.rest(job, 0.002 * chance.random())
            elif what < 0.72:
                raise DefectError
        self.queue.send(job)
        time.sleep(chance.choice([0.0, 0.001, 0.01]))

    def _end(self, requests):
        with self._lock:
            self.ended += requests


@pytest.mark.parametrize("seed", range(3))
def test_every_request_ends_once_whatever_happens(seed):
    server = Server(seed)
    askers = [threading.Thread(target=server.ask, args=(f"asker-{n}",)) for n in range(ASKERS)]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join()
    deadline = time.monotonic() + WAIT_S
    while len(server.ended) < ASKERS * REQUESTS:
        assert time.monotonic() < deadline, "a request never ended"
        time.sleep(0.01)
    server.close()
    assert len(set(server.ended)) == ASKERS * REQUESTS
    assert server.queue.metrics.waiting == 0
