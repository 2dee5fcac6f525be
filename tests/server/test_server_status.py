"""Whether mapping goes on, as a supervisor is told."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from threading import Event, Thread
from typing import cast

import zenoh
from support import servers
from support.clock import Clock
from support.maps.small_world import settings
from triquad_server.epochs.history import EpochHistory
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.mapping.thread_time import ThreadTime
from triquad_server.process.memory_share import ServerMemory
from triquad_server.process.stop import Stop
from triquad_server.server_status import ENDLESS_S, STUCK_S, Health
from triquad_server.serving.operations import Operations
from triquad_server.settings import ServiceSettings, Settings, StoreSettings
from triquad_server.store.checkpoint_writer import CheckpointWriter

COMPUTED_S = 0.5


@contextmanager
def running(
    mapper: Mapper, clock: Clock, failed: Callable[[Stop], None] = lambda _: None
) -> Iterator[tuple[MapperThread, Health]]:
    """A mapper's thread without a store, and its health."""
    scans = ScanQueue(8)
    epochs = EpochHistory(mapper.publish(), ServiceSettings())
    thread = MapperThread(mapper, scans, epochs, 0.5, failed)
    thread.time = ThreadTime(clock)
    health = Health(
        map_name="test",
        server="s",
        device="cpu",
        session=cast(zenoh.Session, None),  # no figures are asked for
        operations=cast(Operations, None),
        scans=scans,
        warnings=ScanWarnings(scans, Settings()),
        mapper=thread,
        epochs=epochs,
        checkpoints=CheckpointWriter(thread, None, StoreSettings()),
        memory=ServerMemory(10**9).open(),
    )
    with closing(thread):
        thread.start()
        yield thread, health


def test_a_server_that_waits_for_scans_is_healthy_as_long_as_it_hears_its_heartbeat() -> None:
    clock = Clock()
    with running(Mapper("test", settings(), "cpu"), clock) as (thread, health):
        for _ in range(3):
            assert any(thread.time.current().waited_s == 0 for _ in range(10**6))
            assert health.problem() is None
            clock.now_s += 10 * STUCK_S
            assert health.mapping_problem() is not None
            thread.wake()  # as the heartbeat does, each second


@contextmanager
def at_work(thread: MapperThread, compute: Callable[[], None] = lambda: None) -> Iterator[None]:
    """The thread has computed something, and does not come back before the context ends."""
    begun, go_on = Event(), Event()

    def work(_: Mapper) -> None:
        compute()
        begun.set()
        assert go_on.wait(servers.WAIT_S)

    caller = Thread(target=thread.call, args=(work,))
    caller.start()
    assert begun.wait(servers.WAIT_S)
    yield
    go_on.set()
    caller.join()


def compute_for_long() -> None:
    """Take processor time."""
    until_s = time.thread_time() + COMPUTED_S
    while time.thread_time() < until_s:
        pass


def test_a_thread_that_computes_for_long_is_healthy_until_that_is_absurd() -> None:
    clock = Clock()
    with (
        running(Mapper("test", settings(), "cpu"), clock) as (thread, health),
        at_work(thread, compute_for_long),
    ):
        clock.now_s += COMPUTED_S + STUCK_S / 2
        assert health.mapping_problem(stuck_s=STUCK_S / 2 + COMPUTED_S / 2) is None
        assert health.mapping_problem(stuck_s=STUCK_S / 2 - COMPUTED_S / 2) is not None
        clock.now_s += ENDLESS_S
        assert health.mapping_problem(stuck_s=2 * ENDLESS_S) is not None


def test_a_thread_that_comes_to_no_end_is_a_problem_until_it_does() -> None:
    clock = Clock()
    with running(Mapper("test", settings(), "cpu"), clock) as (thread, health):
        with at_work(thread):
            clock.now_s += STUCK_S - 1
            assert health.mapping_problem() is None
            clock.now_s += 2
            problem = health.mapping_problem()
            told = f"mapping makes no progress: it is at commands since {STUCK_S + 1:.0f} s"
            assert problem == told
            assert health.problem() == problem
        thread.call(lambda mapper: mapper.settled)
        assert health.problem() is None
