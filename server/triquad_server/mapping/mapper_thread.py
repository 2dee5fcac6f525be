"""The thread that owns the live map: takes scans, trains in slices, publishes epochs."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from triquad_format.wire.messages import FieldFit, ResetReply, ResetRequest, Scan
from triquad_map.box import check_box
from triquad_map.compiled.priority import lower_priority

from triquad_server.counter import Counter
from triquad_server.epochs.history import EpochHistory
from triquad_server.epochs.surface_history import SurfaceHistory
from triquad_server.errors import MapLostError, ScanRefusedError
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.command_queue import CommandQueue
from triquad_server.mapping.map_fit import map_fit
from triquad_server.mapping.map_snapshot import MapSnapshot
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.thread_time import Activity, ThreadTime
from triquad_server.process.threads import NICENESS
from triquad_server.settings import MemorySettings, ServiceSettings

_log = logging.getLogger(__name__)

_GIVE_WAY_S = 0.1

_NO_MEMORY_S = 1.0
"""How long the map waits for memory where it does not suffice."""

_SCANS_S = 0.05
"""Scans are taken in for so long before training goes on, at least."""

_SCANS_SHARE = 2.0
"""How many times as long as all else took, where scans wait for so long."""

_MIN_PUBLISH_SHARE = 5
"""Publishing takes at most one part in so many of the thread's time."""

_SOONEST_PUBLISH_S = 0.1
"""An epoch that a flush waits for comes so long after the one before, at the earliest: however much
is flushed, an epoch that was just asked stays for a moment."""

ResultT = TypeVar("ResultT")


@dataclass(frozen=True)
class Progress:
    """The mapper's numbers, as of its last slice."""

    settled: bool = True  # nothing is left to learn, and the newest epoch shows all
    scans_taken: int = 0  # that are in the map, also those before a restart
    samples_trained: int = 0  # of the map, likewise
    own_samples_trained: int = 0  # by this process
    samples_left: int = 0
    rays_kept: int = 0
    rays_discarded: int = 0
    replay_share: float = 1.0  # of the rays that each place is to keep
    samples_discarded: int = 0
    map_bytes: int = 0  # that the map and its newest epoch take
    normals_bytes: int = 0  # that moments of points take, for normals of coming scans
    loss: float = 0.0
    fit: FieldFit | None = None  # to the rays that are held out


@dataclass(frozen=True)
class Forgotten:
    """What a reset did."""

    before: MapSnapshot  # of the map that was
    epoch: int  # the first that shows it


class MapperThread:
    """Runs a :class:`Mapper`; everything that touches the live map goes through here."""

    def __init__(
        self,
        mapper: Mapper,
        scans: ScanQueue,
        settings: ServiceSettings,
        failed: Callable[[], None],
        warnings: ScanWarnings | None = None,
        memory: MemorySettings | None = None,
    ) -> None:
        """Publish the first epoch; ``failed`` is called where an internal error ends the thread.

        ``warnings`` are told what was used of each scan; ``memory`` bounds the epochs that stay.
        """
        self._mapper = mapper
        self._scans = scans
        self.points_dropped = Counter()  # of scans that were taken, by reason
        self._period_s = settings.publish_period_s
        self._failed = failed
        self.time = ThreadTime()
        self._warnings = warnings
        self._commands = CommandQueue()
        self._wake = threading.Event()
        self._publish_soon = threading.Event()
        self._resting = threading.Event()
        self._stopping = threading.Event()
        self._next_publish = self._soonest_publish = 0.0
        self._unpublished = False
        self._samples_trained = 0
        self._loss = mapper.loss  # as of the newest epoch
        self._step_s = _GIVE_WAY_S  # what the last step of training took
        self._else_s = 0.0  # what all but scans took in the last round
        first = mapper.publish()
        self._fit = map_fit(mapper.regions)
        older_bytes = (memory or MemorySettings()).epochs_bytes
        self.epochs = EpochHistory(first, settings, older_bytes=older_bytes)
        self.surface = SurfaceHistory(first, settings.changes_kept)
        self.trails = SourceTrails(first.field_settings.leaf_m)
        self.progress = Progress()
        self._record_progress()
        self._thread = threading.Thread(target=self._run, name="mapper")

    @property
    def ended(self) -> str | None:
        """Why the thread takes no more commands, once it does not."""
        return self._commands.ended

    def start(self) -> None:
        """Begin to map."""
        self._thread.start()

    def rest(self) -> None:
        """Take no more scans and train no more, but go on carrying out commands."""
        self._resting.set()
        self._wake.set()

    def close(self) -> None:
        """End after the current slice; pending commands are still carried out."""
        self._stopping.set()
        self._wake.set()
        if self._thread.ident is None:
            self._commands.end("the mapper was never started")
        else:
            self._thread.join()

    def wake(self) -> None:
        """Have the thread see whether scans are waiting."""
        self._wake.set()

    def publish_soon(self) -> None:
        """Publish once the current slice is over, without waiting for the whole period."""
        self._publish_soon.set()
        self._wake.set()

    def call(self, command: Callable[[Mapper], ResultT]) -> ResultT:
        """What ``command`` returns when run on the mapper thread, between slices.

        Raises:
            MapperStoppedError: the thread has ended, or ends before it comes to the command.
        """
        result = self._commands.add(command)
        self._wake.set()
        return result.result()

    def reset(self, request: ResetRequest) -> ResetReply:
        """Forget what lies in the request's box; answered once an epoch shows it.

        Raises:
            RefusedError: it is not a box.
        """
        check_box(request.minimum, request.maximum)
        return ResetReply(self.call(lambda mapper: self._forget(mapper, request)))

    def reset_after(self, request: ResetRequest, base: int | None) -> Forgotten:
        """As :meth:`reset`, with the map as it was just before: no scan comes in between.

        ``base`` is the epoch after which changes are enough; ``None``: all is needed.

        Raises:
            RefusedError: it is not a box.
        """
        check_box(request.minimum, request.maximum)

        def reset(mapper: Mapper) -> Forgotten:
            return Forgotten(mapper.snapshot_since(base), self._forget(mapper, request))

        return self.call(reset)

    def _forget(self, mapper: Mapper, request: ResetRequest) -> int:
        mapper.reset(request.minimum, request.maximum)
        self.trails.forget(request.minimum, request.maximum)
        return mapper.publish().number

    def _run(self) -> None:
        lower_priority(NICENESS)
        ended = "the mapper has stopped"
        try:
            while not self._stopping.is_set():
                self._turn_safely()
            self._run_commands()
            self._publish()
        except Exception:
            ended = "the mapper has stopped: internal error, see the server's log"
            _log.exception("the mapper was stopped by an internal error")
            self._failed()
        finally:
            self._commands.end(ended)

    def _turn_safely(self) -> None:
        """As :meth:`_turn`; too little memory to train or publish holds it up for a while only."""
        try:
            self._turn()
        except MemoryError as error:
            _log.warning("too little memory to go on mapping, tried again soon: %s", error)
            self.time.begin(Activity.IDLE)
            self._unpublished = True
            self._wake.wait(_NO_MEMORY_S)

    def _turn(self) -> None:
        """One round: commands, scans, a slice of training, an epoch where one is due."""
        self._wake.clear()
        self.epochs.let_go()  # first: where memory is short, nothing below may come to its end
        self._run_commands()
        if self._resting.is_set():
            self.time.begin(Activity.IDLE)
            self._wake.wait()
            return
        took_scans = self._ingest_scans()
        ingested_s = time.monotonic()
        if not self._mapper.settled:
            self.time.begin(Activity.GIVING_WAY)
            # However many ask, training waits a third of its time at most.
            self.epochs.give_way(min(_GIVE_WAY_S, self._step_s / 2))
            self.time.begin(Activity.TRAINING)
            started = time.monotonic()
            trained = self._mapper.samples_trained
            self._mapper.train()
            self._samples_trained += self._mapper.samples_trained - trained
            self._step_s = time.monotonic() - started
            self._unpublished = True
        if self._is_publish_due():
            self._publish_soon.clear()
            self._publish()
        self._record_progress()
        self._else_s = time.monotonic() - ingested_s
        if self._mapper.settled and not took_scans:
            self.time.begin(Activity.IDLE)
            if not self.epochs.is_recent:
                self._mapper.release()
            self._wake.wait(self._rest_s())

    def _is_publish_due(self) -> bool:
        now = time.monotonic()
        if self._publish_soon.is_set():
            return now >= self._soonest_publish
        return self._unpublished and now >= self._next_publish

    def _run_commands(self) -> None:
        while (command := self._commands.take()) is not None:
            self.time.begin(Activity.COMMANDS)
            try:
                result = command.run(self._mapper)
                self._publish()  # first: whoever gets the result may ask for its epoch
            except BaseException as error:
                self._unpublished = True
                command.result.set_exception(error)
            else:
                command.result.set_result(result)

    def _ingest_scans(self) -> bool:
        """Take in the oldest scan of each source, for a moment; False where none waits.

        More are taken of sources of which so many wait that scans may soon be lost.
        """
        ends_s = time.monotonic() + max(_SCANS_S, _SCANS_SHARE * self._else_s)
        sources: set[str] = set()
        while (scan := self._scans.take(sources)) is not None:
            sources.add(scan.source)
            self._ingest(scan)
            if time.monotonic() > ends_s:
                break
        return bool(sources)

    def _ingest(self, scan: Scan) -> None:
        self.time.begin(Activity.SCANS)
        try:
            rays = self._mapper.ingest(
                scan.points,
                scan.world_from_sensor,
                scan.stamp_ns // 1_000_000_000,
                source=scan.source,
                no_return=scan.no_return,
            )
        except MapLostError:
            raise
        except ScanRefusedError as error:
            self._scans.dropped.add(error.reason)
            self._scans.ledger.refuse(scan, str(error))
            if error.reason == "out_of_memory":
                self._take_back(str(error))
            _log.debug("scan %d of %s refused: %s", scan.sequence, scan.source, error)
        except Exception as error:  # bad input, whatever it is, must not stop the server
            self._scans.dropped.add("internal")
            text = f"internal error of the server: {error!r}"
            self._scans.ledger.refuse(scan, text)
            self._take_back(text)
            _log.exception("scan %d of %s could not be taken in", scan.sequence, scan.source)
        else:
            for reason, count in rays.points_dropped.items():
                self.points_dropped.add(reason, count)
            if self._warnings is not None:
                self._warnings.add(scan.source, len(scan.points), rays)
            self.trails.add(scan, rays)
            self._unpublished = True
            self._scans.ledger.take(scan)

    def _take_back(self, why: str) -> None:
        """Count as refused what no epoch shows yet: a scan failed, and the map went back."""
        count = self._scans.ledger.take_back(why)
        if count:
            _log.warning("%d scans were taken back with one that failed: %s", count, why)

    def _publish(self) -> None:
        self.time.begin(Activity.PUBLISHING)
        started = time.monotonic()
        epoch = self._mapper.publish()
        if epoch is not self.epochs.newest:
            self.surface.add(epoch)
            self.epochs.add(epoch)
        self._loss = self._mapper.loss
        self._fit = map_fit(self._mapper.regions)
        self._unpublished = False
        now = time.monotonic()
        self._next_publish = now + max(self._period_s, _MIN_PUBLISH_SHARE * (now - started))
        self._soonest_publish = now + min(self._period_s, _SOONEST_PUBLISH_S)
        self._scans.ledger.publish()

    def _rest_s(self) -> float | None:
        """How long there is nothing to do; None: until woken."""
        if self._publish_soon.is_set():
            return max(0.0, self._soonest_publish - time.monotonic())
        return max(0.0, self._next_publish - time.monotonic()) if self._unpublished else None

    def _record_progress(self) -> None:
        self.progress = Progress(
            settled=self._mapper.settled and not self._unpublished,
            scans_taken=self._mapper.scans_taken,
            samples_trained=self._mapper.samples_trained,
            own_samples_trained=self._samples_trained,
            samples_left=self._mapper.samples_left,
            rays_kept=self._mapper.rays_kept,
            rays_discarded=self._mapper.rays_discarded,
            replay_share=self._mapper.replay_share,
            samples_discarded=self._mapper.samples_discarded,
            map_bytes=self._mapper.bytes_used,
            normals_bytes=self._mapper.normals_bytes,
            loss=self._loss,
            fit=self._fit,
        )
