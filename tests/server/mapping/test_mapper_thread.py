from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from support import servers
from support.small_world import settings, world
from triquad_format.errors import RefusedError
from triquad_format.wire.messages import CheckpointRequest, ResetRequest
from triquad_server.epochs.epoch import Epoch
from triquad_server.errors import MapperStoppedError
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.mapping import mapper_thread
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.settings import ServiceSettings, StoreSettings
from triquad_server.store.checkpoint_thread import CheckpointThread
from triquad_server.store.store import Store

NEVER_S = 3600.0
SETTINGS = ServiceSettings(publish_period_s=NEVER_S, epochs_kept=4, epochs_pinned=0, pin_s=0.0)


@contextmanager
def running(
    mapper: Mapper, failed: Callable[[], None] = lambda: None, settings: ServiceSettings = SETTINGS
) -> Iterator[MapperThread]:
    """The thread of a mapper; with these settings it publishes when a command asks for it."""
    with closing(MapperThread(mapper, ScanQueue(8), settings, failed)) as thread:
        thread.start()
        yield thread


def learning_mapper(kind: type[Mapper] = Mapper) -> Mapper:
    """A mapper that has enough to learn for the whole test."""
    mapper = kind("test", settings(samples_per_ray=1000.0), "cpu")
    scan = world(1).scans[0]
    mapper.ingest(scan.points, scan.world_from_sensor)
    return mapper


def test_a_command_returns_its_result_or_raises_its_error() -> None:
    with running(Mapper("test", settings(), "cpu")) as thread:
        assert thread.call(lambda mapper: len(mapper.regions)) == 0
        with pytest.raises(ZeroDivisionError):
            thread.call(lambda _: 1 // 0)
        assert thread.call(lambda mapper: mapper.settled)


def test_commands_of_a_thread_that_ended_are_refused() -> None:
    with running(Mapper("test", settings(), "cpu")) as thread:
        pass
    with pytest.raises(MapperStoppedError, match="has stopped"):
        thread.call(lambda mapper: mapper.settled)


def test_however_much_is_flushed_epochs_keep_a_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapper_thread, "_SOONEST_PUBLISH_S", NEVER_S)
    with running(learning_mapper()) as thread:
        thread.call(lambda mapper: mapper.settled)
        before = thread.epochs.newest
        thread.publish_soon()
        trained = thread.progress.samples_trained
        while thread.progress.samples_trained < trained + 10:
            pass
        assert thread.epochs.newest is before


class FailingMapper(Mapper):
    """Its training meets an internal error."""

    def train(self) -> None:
        raise RuntimeError("training failed")


def test_commands_of_a_thread_that_failed_are_refused_with_the_cause() -> None:
    failed = Event()
    with running(learning_mapper(FailingMapper), failed.set) as thread:
        assert failed.wait(servers.WAIT_S)
        with pytest.raises(MapperStoppedError, match="internal error"):
            thread.call(lambda mapper: mapper.settled)


class ShortOfMemory(Mapper):
    """There is too little memory, now to train and then to publish, once it is told."""

    shortages = ("train", "publish")

    def train(self) -> None:
        self._run_short("train")
        super().train()

    def publish(self) -> Epoch:
        self._run_short("publish")
        return super().publish()

    def _run_short(self, activity: str) -> None:
        if self.shortages and self.samples_trained and self.shortages[0] == activity:
            self.shortages = self.shortages[1:]
            raise MemoryError


def test_too_little_memory_for_a_moment_does_not_end_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapper_thread, "_NO_MEMORY_S", 0.0)
    mapper = learning_mapper(ShortOfMemory)
    with running(mapper) as thread:
        while mapper.shortages:
            thread.publish_soon()
        trained = thread.call(lambda mapper: mapper.samples_trained)
        while thread.call(lambda mapper: mapper.samples_trained) == trained:
            pass
        assert thread.epochs.newest.number > 0


class OutOfMemory(Mapper):
    """There is too little memory to train, from some moment on."""

    is_short = False

    def train(self) -> None:
        if self.is_short:
            raise MemoryError
        super().train()


def test_older_epochs_are_let_go_while_memory_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody asks for one by number, which would have the others let go, too."""
    monkeypatch.setattr(mapper_thread, "_NO_MEMORY_S", 0.0)
    quick = SETTINGS.model_copy(update={"publish_period_s": 0.01})
    mapper = learning_mapper(OutOfMemory)
    with running(mapper, settings=quick) as thread:
        while len(thread.epochs.kept().epochs) < 2:
            thread.publish_soon()
        mapper.is_short = True
        while len(thread.epochs.kept().epochs) > 1:
            thread.epochs.get(0)


def test_older_epochs_are_let_go_while_mapping_rests() -> None:
    quick = SETTINGS.model_copy(update={"publish_period_s": 0.01})
    with running(learning_mapper(), settings=quick) as thread:
        while len(thread.epochs.kept().epochs) < 2:
            thread.publish_soon()
        thread.rest()
        while len(thread.epochs.kept().epochs) > 1:
            thread.wake()  # as a heartbeat does


def test_pending_commands_fail_when_the_thread_will_not_come_to_them() -> None:
    thread = MapperThread(
        Mapper("test", settings(), "cpu"), ScanQueue(8), SETTINGS, failed=lambda: None
    )
    with ThreadPoolExecutor(1) as pool:
        pending = pool.submit(thread.call, lambda mapper: mapper.settled)
        thread.close()
        with pytest.raises(MapperStoppedError, match="never started"):
            pending.result(servers.WAIT_S)


def test_whoever_reset_the_map_finds_the_epoch_that_shows_it() -> None:
    box = np.full(3, -np.inf), np.full(3, np.inf)
    with running(learning_mapper()) as thread:
        reply = thread.reset(ResetRequest(*box))
        assert thread.epochs.newest.number >= reply.epoch
        assert thread.epochs.get(reply.epoch).regions == 0


def test_a_checkpoint_takes_one_epoch_however_fast_the_map_changes(tmp_path: Path) -> None:
    store = Store(tmp_path, "test", StoreSettings())
    with closing(store), running(learning_mapper()) as thread:
        checkpoints = CheckpointThread(thread, store, 0.0, None)
        checkpoints.start()
        with closing(checkpoints):
            for _ in range(5):
                before = thread.call(lambda mapper: mapper.publish().number)
                info = checkpoints.answer(CheckpointRequest())
                assert info.epoch <= before + 1
                assert thread.epochs.newest.number == info.epoch
            thread.rest()


def test_a_checkpoint_for_which_there_is_no_memory_is_refused_and_the_next_one_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path, "test", StoreSettings())
    with closing(store), running(learning_mapper()) as thread:
        checkpoints = CheckpointThread(thread, store, 0.0, None)
        checkpoints.start()
        with closing(checkpoints):
            with monkeypatch.context() as patched:
                patched.setattr(Mapper, "snapshot_since", lambda *_: bytes(2**60))
                with pytest.raises(RefusedError, match="store: .* out of memory"):
                    checkpoints.answer(CheckpointRequest())
            assert checkpoints.answer(CheckpointRequest()).epoch == thread.epochs.newest.number
            thread.rest()
