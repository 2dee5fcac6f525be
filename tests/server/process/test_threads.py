"""The work of a question is done at the priority of the thread that answers it."""

import os
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
from triquad_map.compiled.team import THREADS, lower_priority
from triquad_server.process.threads import NICENESS, Teams


@pytest.mark.skipif(sys.platform != "linux", reason="threads have priorities on Linux alone")
@pytest.mark.skipif(THREADS == 1, reason="one core: the thread that answers does all the work")
@pytest.mark.parametrize("niceness", [0, NICENESS])
def test_all_parts_have_the_priority_of_the_thread_that_answers(niceness):
    priorities = []
    together = threading.Barrier(THREADS)  # no thread does two parts

    def work(_first, _last):
        together.wait()
        priorities.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    with (
        closing(Teams()) as teams,
        ThreadPoolExecutor(1, "worker", lower_priority, (niceness,)) as workers,
    ):
        workers.submit(teams.answer, THREADS, work, 1).result()
    own = os.getpriority(os.PRIO_PROCESS, os.getpid())
    assert priorities == [min(19, own + niceness)] * THREADS
