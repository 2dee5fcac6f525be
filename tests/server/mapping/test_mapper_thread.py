"""The thread that owns the live map."""

import queue
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from support import servers
from support.maps.small_world import settings, world
from triquad_format.errors import RefusedError
from triquad_format.wire.messages import CheckpointRequest
from triquad_server.epochs.history import EpochHistory
from triquad_server.errors import MapperStoppedError
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.mapping import mapper as mapper_module
from triquad_server.mapping import mapper_thread as mapper_thread_module
from triquad_server.mapping import thread_time
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread, _Phase
from triquad_server.process.stop import Stop, Stops
from triquad_server.settings import ServiceSettings, StoreSettings
from triquad_server.store.checkpoint_writer import CheckpointWriter
from triquad_server.store.store import Store

NEVER_S = 3600.0
SETTINGS = ServiceSettings(publish_period_s=NEVER_S, epochs_kept=4, epochs_pinned=0, pin_s=0.0)


@dataclass
class Mapping:
    """The thread of a mapper with what it works on; with these settings commands alone publish."""

    mapper: Mapper
    settings: ServiceSettings = SETTINGS
    scans: ScanQueue = field(default_factory=lambda: ScanQueue(8))
    stops: Stops = field(default_factory=queue.SimpleQueue)

    def __post_init__(self) -> None:
        self.epochs = EpochHistory(self.mapper.publish(), self.settings)
        self.thread = MapperThread(
            self.mapper,
            self.scans,
            self.epochs,
            self.settings.publish_period_s,
            self.stops.put,
        )

    def ended(self, why: Stop = Stop.INTERNAL_ERROR) -> str:
        """What the thread says to commands, once it has ended for that reason."""
        assert self.stops.get(timeout=servers.WAIT_S) is why
        with pytest.raises(MapperStoppedError) as refused:
            self.thread.call(lambda mapper: mapper.settled)
        return str(refused.value)


@contextmanager
def running(mapper: Mapper, settings: ServiceSettings = SETTINGS) -> Iterator[Mapping]:
    """The thread of a mapper, started."""
    mapping = Mapping(mapper, settings)
    with closing(mapping.thread):
        mapping.thread.start()
        yield mapping


class CountedMapper(Mapper):
    """Tells when it has taken some more steps of training."""

    steps_left = 0
    trained = Event()

    def train(self) -> None:
        super().train()
        self.steps_left -= 1
        if self.steps_left == 0:
            self.trained.set()


def learning_mapper(kind: type[Mapper] = Mapper) -> Mapper:
    """A mapper that has enough to learn for the whole test."""
    mapper = kind("test", settings(samples_per_ray=1000.0), "cpu")
    scan = world(1).scans[0]
    mapper.ingest(scan.points, scan.world_from_sensor)
    return mapper


def test_a_command_returns_its_result_or_raises_its_error() -> None:
    def refuse(_: Mapper) -> None:
        raise RefusedError("bad_request", "refused")

    with running(Mapper("test", settings(), "cpu")) as mapping:
        assert mapping.thread.call(lambda mapper: len(mapper.regions)) == 0
        with pytest.raises(RefusedError):
            mapping.thread.call(refuse)
        assert mapping.thread.call(lambda mapper: mapper.settled)
        with pytest.raises(ZeroDivisionError):
            mapping.thread.call(lambda _: 1 // 0)
        assert "internal error" in mapping.ended(), "what else it left undone, nobody knows"


def test_without_training_scans_are_taken_in_and_nothing_is_learnt() -> None:
    with running(learning_mapper()) as mapping:
        with mapping.thread.without_training():
            before = mapping.thread.call(lambda mapper: mapper.samples_trained)
            mapping.scans.put(servers.scan())
            mapping.thread.wake()
            servers.until(lambda: mapping.thread.call(lambda mapper: mapper.scans_taken) == 2)
            assert mapping.thread.call(lambda mapper: mapper.samples_trained) == before
        servers.until(lambda: mapping.thread.progress.own_samples_trained > before)


def test_an_end_that_comes_as_a_turn_begins_is_not_slept_through(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    turn, asked, begun = MapperThread._turn, Event(), Event()

    def held_turn(self: MapperThread, else_s: float) -> float:
        begun.set()
        asked.wait(servers.WAIT_S)
        return turn(self, else_s)

    monkeypatch.setattr(MapperThread, "_turn", held_turn)
    with running(Mapper("test", settings(), "cpu")) as mapping:
        assert begun.wait(servers.WAIT_S)
        mapping.thread.pause()
        closing_thread = threading.Thread(target=mapping.thread.close, daemon=True)
        closing_thread.start()
        while mapping.thread._phase is not _Phase.ENDING:
            time.sleep(0.01)
        time.sleep(0.1)
        asked.set()
        closing_thread.join(10.0)
        assert not closing_thread.is_alive()


def test_however_much_is_flushed_epochs_keep_a_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread_time, "_SOONEST_PUBLISH_S", NEVER_S)
    mapper = learning_mapper(CountedMapper)
    with running(mapper) as mapping:
        mapping.thread.call(lambda mapper: mapper.settled)
        before = mapping.epochs.newest
        mapping.thread.publish_soon()
        mapper.steps_left = 4
        assert mapper.trained.wait(servers.WAIT_S)
        assert mapping.epochs.newest is before


@pytest.mark.parametrize(
    ("error", "why", "text"),
    [
        (RuntimeError("a defect"), Stop.INTERNAL_ERROR, "internal error"),
        (MemoryError("4 MiB"), Stop.NO_MEMORY, "no more memory"),
    ],
)
def test_a_scan_that_fails_midway_ends_the_mapping_and_no_epoch_shows_it(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    error: Exception,
    why: Stop,
    text: str,
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(LiveRegion, "scan_taken", fail)
    with running(Mapper("test", settings(), "cpu")) as mapping:
        before = mapping.epochs.newest
        mapping.scans.put(servers.scan(0))
        mapping.thread.wake()
        assert text in mapping.ended(why)
        assert text in caplog.text
        assert ("Traceback" in caplog.text) == (why is Stop.INTERNAL_ERROR)
        assert mapping.epochs.newest is before
        assert not mapping.scans.ledger.outcome("lidar", 7, 0).done, "it is not told as taken"


@pytest.mark.parametrize(
    ("error", "reason"),
    [(ZeroDivisionError("a defect"), "internal"), (MemoryError("4 MiB"), "no_memory")],
)
def test_a_scan_that_cannot_be_read_here_is_refused_and_mapping_goes_on(
    monkeypatch: pytest.MonkeyPatch, error: Exception, reason: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    with running(Mapper("test", settings(), "cpu")) as mapping:
        with monkeypatch.context() as patched:
            patched.setattr(mapper_module, "usable_rays", fail)
            mapping.scans.put(servers.scan(0))
            mapping.thread.wake()
            while not (reply := mapping.scans.ledger.outcome("lidar", 7, 0)).done:
                time.sleep(0.01)
        assert (reply.taken, reply.refused) == (0, 1)
        assert mapping.scans.dropped == {reason: 1}
        mapping.scans.put(servers.scan(1))
        mapping.thread.wake()
        while mapping.thread.call(lambda mapper: mapper.scans_taken) == 0:
            pass
        assert mapping.epochs.newest.regions == 1


def test_pending_commands_fail_when_the_thread_will_not_come_to_them() -> None:
    thread = Mapping(Mapper("test", settings(), "cpu")).thread
    with ThreadPoolExecutor(1) as pool:
        pending = pool.submit(thread.call, lambda mapper: mapper.settled)
        thread.close()
        with pytest.raises(MapperStoppedError, match="never started"):
            pending.result(servers.WAIT_S)


class HeldMapper(Mapper):
    """Goes on with a scan once it is let."""

    def __init__(self) -> None:
        super().__init__("test", settings(), "cpu")
        self.begun, self.goes_on = Event(), Event()

    def ingest(self, *scan: Any, **options: Any) -> ScanRays:
        self.begun.set()
        assert self.goes_on.wait(servers.WAIT_S)
        return super().ingest(*scan, **options)


def test_a_command_waits_for_no_more_than_the_scan_that_is_taken_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mapper_thread_module, "_SCANS_S", NEVER_S)
    with running(held := HeldMapper()) as mapping, ThreadPoolExecutor(1) as pool:
        for source in ("one", "two", "three"):
            mapping.scans.put(replace(servers.scan(0), source=source))
        mapping.thread.wake()
        assert held.begun.wait(servers.WAIT_S)
        done = pool.submit(mapping.thread.call, lambda mapper: mapper.scans_taken)
        servers.until(lambda: bool(mapping.thread._commands))
        held.goes_on.set()
        assert done.result(servers.WAIT_S) == 1


def test_a_checkpoint_takes_one_epoch_however_fast_the_map_changes(tmp_path: Path) -> None:
    store = Store(tmp_path, "test", StoreSettings())
    with closing(store), running(learning_mapper()) as mapping:
        thread = mapping.thread
        checkpoints = CheckpointWriter(thread, store, StoreSettings(period_s=0))
        checkpoints.start()
        with closing(checkpoints):
            for _ in range(5):
                before = thread.call(lambda mapper: mapper.publish().number)
                info = checkpoints.answer(CheckpointRequest())
                assert info.epoch <= before + 1
                assert mapping.epochs.newest.number == info.epoch
            thread.pause()


def test_a_checkpoint_for_which_there_is_no_memory_is_refused_and_the_next_is_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_: object) -> None:
        raise MemoryError("4 MiB")

    store = Store(tmp_path, "test", StoreSettings())
    with closing(store), running(learning_mapper()) as mapping:
        checkpoints = CheckpointWriter(mapping.thread, store, StoreSettings(period_s=0))
        with monkeypatch.context() as patched:
            patched.setattr(store, "write", fail)
            with pytest.raises(RefusedError, match="store: .*no more memory"):
                checkpoints.answer(CheckpointRequest())
        assert checkpoints.error is not None
        assert checkpoints.metrics().failed == 1
        assert checkpoints.answer(CheckpointRequest()) == checkpoints.last
        assert checkpoints.error is None


def test_checkpoints_that_are_late_are_told_until_one_is_written(tmp_path: Path) -> None:
    """While the mapper's thread is kept at something else, the map cannot be saved."""
    store, let_go = Store(tmp_path, "test", StoreSettings()), Event()
    with closing(store), running(learning_mapper()) as mapping, ThreadPoolExecutor() as pool:
        checkpoints = CheckpointWriter(mapping.thread, store, StoreSettings(period_s=2))
        assert (checkpoints.warning, checkpoints.metrics().late_s) == (None, 0.0)
        checkpoints.start()
        with closing(checkpoints):
            pool.submit(mapping.thread.call, lambda _: let_go.wait(servers.WAIT_S))
            servers.until(lambda: checkpoints.warning is not None)
            assert "store.period_s = 2" in (checkpoints.warning or "")
            assert checkpoints.metrics().late_s > 0
            let_go.set()
            servers.until(lambda: checkpoints.warning is None)
        assert checkpoints.last is not None
