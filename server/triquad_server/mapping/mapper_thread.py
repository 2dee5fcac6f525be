"""The thread that owns the live map: it takes scans, trains in slices, and publishes epochs."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum

from triquad_format.records.field_settings import RegionIndex
from triquad_format.wire.codec import moved
from triquad_format.wire.messages import Scan
from triquad_map.compiled.team import lower_priority

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.errors import (
    NO_MEMORY,
    NoRoomYetError,
    ScanRefusedError,
)
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.mapping.commands import Commands, ResultT
from triquad_server.mapping.live_region import OwedCopy, RegionSnapshot
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.progress import Progress
from triquad_server.mapping.thread_time import Activity, PublishSchedule, ThreadTime
from triquad_server.process.stop import Stop
from triquad_server.process.threads import NICENESS

_log = logging.getLogger(__name__)

_GIVE_WAY_S = 0.1  # seconds that training waits for queries before each step, at most

_SCANS_S = 0.05
"""The seconds for which scans are taken in before training goes on, at least."""

_SCANS_SHARE = 6.0
"""The time for which scans are taken in where many wait, as a multiple of what all else took. While
three clients ask for too much, a lidar loses 2 to 8 of 100 scans with 2, and none to 4 with 6
(``make bench PART=server``)."""


class _Phase(Enum):
    MAPPING = 1
    PAUSED = 2  # commands are carried out, and nothing else
    ENDING = 3


class MapperThread:
    """Runs a :class:`Mapper`; everything that touches the live map goes through here."""

    def __init__(
        self,
        mapper: Mapper,
        scans: ScanQueue,
        epochs: EpochHistory,
        period_s: float,
        failed: Callable[[Stop], None],
        scan_taken: Sequence[Callable[[Scan, ScanRays], None]] = (),
        scan_learnt: Callable[[Scan, ScanRays], None] = lambda _scan, _rays: None,
        published: Callable[[Epoch], None] = lambda _: None,
    ) -> None:
        """Make the thread, which begins with :meth:`start`.

        Args:
            mapper: what owns the map; its newest epoch is in ``epochs``.
            scans: from where scans are taken.
            epochs: where epochs are published.
            period_s: between two epochs while the map changes.
            failed: called with the reason where an error ends the thread.
            scan_taken: called with each scan, and what of it is used, from the map's origin.
            scan_learnt: likewise, where it reaches regions that this server has.
            published: called with each epoch before others can see it; these are quick, and raise
                nothing.
        """
        self._mapper = mapper
        self._scans = scans
        self._epochs = epochs
        self._failed = failed
        self._scan_taken = scan_taken
        self._scan_learnt = scan_learnt
        self._published = published
        self.time = ThreadTime()
        self._stored: deque[Mapping[RegionIndex, ColdRegion] | None] = deque(maxlen=1)
        self._wake = threading.Event()
        self._commands = Commands(self._wake.set)
        self._waiting: Scan | None = None  # for room in the map
        self._phase = _Phase.MAPPING
        self._schedule = PublishSchedule(period_s)
        self.progress = Progress(loss=mapper.loss, fit=mapper.regions.fit)
        self._record_progress()
        self._thread = threading.Thread(target=self._run, name="mapper")

    @property
    def ended(self) -> str | None:
        """Why the thread takes no more commands; ``None``: it does."""
        return self._commands.ended

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    @contextmanager
    def without_training(self) -> Iterator[None]:
        """Train nothing while the context is open: who makes regions again takes the cores."""
        self._mapper.rests = True
        try:
            yield
        finally:
            self._mapper.rests = False
            self._wake.set()

    def stored(self, regions: Mapping[RegionIndex, ColdRegion] | None) -> None:
        """Tell what the store has of the regions, so that those that wait for it leave memory.

        ``None``: it cannot be written to.
        """
        self._stored.append(regions)
        self._wake.set()

    def pause(self) -> None:
        """Take no more scans and train no more, but go on carrying out commands."""
        self._phase = _Phase.PAUSED
        self._wake.set()

    def close(self) -> None:
        """End after the current slice; pending commands are still carried out."""
        self._phase = _Phase.ENDING
        self._wake.set()
        if self._thread.ident is None:
            self._commands.end("the mapper was never started")
        else:
            self._thread.join()

    def wake(self) -> None:
        """Make the thread check whether scans are waiting."""
        self._wake.set()

    def publish_soon(self) -> None:
        """Publish once the current slice is over, without waiting for the whole period."""
        self._schedule.ask()
        self._wake.set()

    def call(self, command: Callable[[Mapper], ResultT]) -> ResultT:
        """Run ``command`` on the mapper thread, between slices, and return its result.

        Once it returns, an epoch shows what it did. Errors: :meth:`Commands.carried_out`.
        """
        return self._commands.carried_out(command, changes=True)

    def ask(self, command: Callable[[Mapper], ResultT]) -> ResultT:
        """Do as :meth:`call`, but return at once: an epoch shows it when the next one is due."""
        return self._commands.carried_out(command, changes=False)

    def taken(self, owed: OwedCopy) -> RegionSnapshot:
        """Return the copy of a region, taken by the thread; errors are those of :meth:`call`."""
        return self.ask(lambda _: owed.take())

    def _run(self) -> None:
        lower_priority(NICENESS)
        ended = "the mapper has stopped"
        try:
            else_s = 0.0
            while self._phase is not _Phase.ENDING:
                else_s = self._turn(else_s)
                self._wake.clear()  # before what it told of is looked at, the end among it
            self._run_commands()
            self._publish()
        except MemoryError as error:
            ended += f", {Stop.NO_MEMORY.value}"
            _log.critical("%s: mapping ends, %s", NO_MEMORY, error)
            self._failed(Stop.NO_MEMORY)
        except Exception:
            ended += f" {Stop.INTERNAL_ERROR.value}, see the server's log"
            _log.exception("the mapper was stopped by an internal error")
            self._failed(Stop.INTERNAL_ERROR)
        finally:
            self._commands.end(ended)

    def _turn(self, else_s: float) -> float:
        """Run one round: commands, scans, a slice of training, an epoch if one is due.

        ``else_s`` is the time of all but scans in the last round; return the same of this one.
        """
        self._epochs.remove_expired()
        if self._stored:
            self._mapper.regions.room.stored(self._stored.pop())
        self._run_commands()
        if self._phase is not _Phase.MAPPING:
            self.time.begin(Activity.IDLE)
            self._wake.wait()
            return else_s
        took_scans = self._ingest_scans(max(_SCANS_S, _SCANS_SHARE * else_s))
        ingested_s = time.monotonic()
        learnt = not self._mapper.rests and self._learn(idle=not took_scans)
        if self._schedule.take_due():
            self._publish()
        self._record_progress()
        else_s = time.monotonic() - ingested_s
        if not (learnt or took_scans):
            self.time.begin(Activity.IDLE)
            if not self._epochs.is_recent:
                self._mapper.release()
            # Another map may have been created, whose share this one had.
            self._schedule.is_changed |= self._mapper.regions.room.make_again()
            self._wake.wait(self._schedule.left_s)
        return else_s

    def _learn(self, idle: bool) -> bool:
        """Take one step of training; return False where there is nothing to learn.

        Where the thread is ``idle``, a region that left memory before it had settled comes back.
        """
        if not self._commands.is_empty:
            return True
        if self._mapper.regions.next_to_learn is None:
            self.time.begin(Activity.TRAINING)
            is_full = self._mapper.regions.room.is_full
            return idle and not is_full and self._mapper.regions.fetch_unsettled()
        self._train()
        return True

    def _train(self) -> None:
        """Take one step of training, which gives way to queries for a third of its time at most."""
        self.time.begin(Activity.GIVING_WAY)
        self._epochs.give_way(min(_GIVE_WAY_S, self.progress.step_s / 2))
        self.time.begin(Activity.TRAINING)
        started_s, before = time.monotonic(), self._mapper.samples_trained
        self._mapper.train()
        own = self.progress.own_samples_trained + self._mapper.samples_trained - before
        step_s = time.monotonic() - started_s
        self.progress = replace(self.progress, own_samples_trained=own, step_s=step_s)
        self._schedule.is_changed = True

    def _run_commands(self) -> None:
        while not self._commands.is_empty:
            self.time.begin(Activity.COMMANDS)
            if not self._commands.run_next(self._mapper, self._publish):
                self._schedule.is_changed = True
            self._record_progress()

    def _ingest_scans(self, for_s: float) -> bool:
        """Take in the oldest scan of each source, for a moment; return False where none waits.

        More are taken of sources of which many wait, so that scans may soon be lost.
        """
        ends_s = time.monotonic() + for_s
        sources: set[str] = set()
        room = self._mapper.regions.room
        while not room.is_full and (scan := self._waiting or self._scans.take(sources)):
            self._waiting = None
            sources.add(scan.source)
            self._ingest(scan)
            if self._waiting or not self._commands.is_empty or time.monotonic() > ends_s:
                break  # a command is at most a scan late: checkpoints begin when they are due
        return bool(sources) and self._waiting is None

    def _ingest(self, scan: Scan) -> None:
        self.time.begin(Activity.SCANS)
        before = self._mapper.scans_taken
        try:
            rays = self._mapper.ingest(
                scan.points,
                scan.world_from_sensor,
                scan.stamp_ns // 1_000_000_000,
                source=scan.source,
                no_return=scan.no_return,
                local=scan.local,
            )
        except NoRoomYetError:
            self._waiting = scan
            return
        except ScanRefusedError as error:
            self._scans.reject(scan, error.reason, str(error))
            _log.debug("scan %d of %s refused: %s", scan.sequence, scan.source, error)
            return
        if self._mapper.origin is not self._epochs.newest.origin:
            self._publish()  # what is told of the scan counts from the origin that it chose
        seen = moved(scan, -rays.map_origin)
        for listener in self._scan_taken:
            listener(seen, rays)
        if self._mapper.scans_taken > before:
            self._scan_learnt(seen, rays)
            self._schedule.is_changed = True
        self._scans.taken(scan, rays)

    def _publish(self) -> None:
        self.time.begin(Activity.PUBLISHING)
        started = time.monotonic()
        epoch = self._mapper.publish()
        if epoch is not self._epochs.newest:
            self._published(epoch)
            self._epochs.add(epoch)
        self.progress = replace(self.progress, loss=self._mapper.loss, fit=self._mapper.regions.fit)
        self._schedule.published(took_s=time.monotonic() - started)
        self._scans.ledger.publish()

    def _record_progress(self) -> None:
        has_all = self._waiting is None and not self._schedule.is_changed
        self.progress = replace(
            self.progress,
            settled=has_all and self._mapper.settled,
            map=self._mapper.figures(),
            waits_for_store=self._mapper.regions.room.waits_for_store,
        )
