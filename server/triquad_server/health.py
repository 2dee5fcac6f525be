"""The server's status: put together from its parts, published once a second, and logged."""

import collections
import logging
import threading
import time
from dataclasses import dataclass, field

import triquad_format
import zenoh
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ServerStatus

from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.net.operation_counts import OperationCounts
from triquad_server.process.memory import give_back_compiler, give_back_free, resident_bytes
from triquad_server.store.checkpoint_thread import CheckpointThread

_log = logging.getLogger(__name__)

STATUS_PERIOD_S = 1.0

STUCK_S = 120.0
"""For no longer the mapper's thread waits without being stuck: for others that compile, at most."""

ENDLESS_S = 1800.0
"""Nothing that it computes takes longer, neither code to compile nor a large checkpoint."""

_BEATS_PER_LOG_LINE = 5
_BEATS_PER_TRIM = 10  # of the memory
_TRIMMED_AT_BYTES = 16 << 20
"""Where memory grew by so much, it is trimmed at once: much was asked."""


@dataclass(frozen=True)
class Health:
    """Knows how the server is doing."""

    map_name: str
    server: str  # a name of this process
    device: str
    operations: dict[str, OperationCounts]
    scans: ScanQueue
    warnings: ScanWarnings
    mapper: MapperThread
    checkpoints: CheckpointThread
    map_max_bytes: int  # beyond which the map does not grow
    started_s: float = field(default_factory=time.monotonic)  # monotonic

    def status(self) -> ServerStatus:
        """The status now."""
        epoch = self.mapper.epochs.newest
        progress = self.mapper.progress
        return ServerStatus(
            map_name=self.map_name,
            server=self.server,
            version=triquad_format.__version__,
            device=self.device,
            epoch=epoch.number,
            settled=progress.settled and len(self.scans) == 0,
            scans_taken=progress.scans_taken,
            scans_dropped=self.scans.dropped.counts(),
            scans_lost=self.scans.ledger.lost(),
            scans_waiting=len(self.scans),
            points_dropped=self.mapper.points_dropped.counts(),
            requests_refused=self._requests_refused(),
            samples_trained=progress.samples_trained,
            rays_kept=progress.rays_kept,
            loss=float(progress.loss),
            regions=epoch.regions,
            vertices=epoch.vertices,
            parameters=epoch.parameters,
            memory_bytes=resident_bytes(),
            uptime_s=time.monotonic() - self.started_s,
            last_checkpoint=self.checkpoints.last,
            store_error=self.checkpoints.error,
            warnings=self.warnings.all(),
            samples_left=progress.samples_left,
            map_bytes=progress.map_bytes,
            map_max_bytes=self.map_max_bytes,
            fit=progress.fit,
            rays_discarded=progress.rays_discarded,
            replay_share=progress.replay_share,
            samples_discarded=progress.samples_discarded,
        )

    def mapping_problem(self, stuck_s: float = STUCK_S) -> str | None:
        """Why nothing is mapped any more, ``None`` where all is well.

        Nothing but a restart helps. A thread that computes is alive, for :data:`ENDLESS_S` at most;
        one that waits is alive if it hears the :class:`Heartbeat`, which wakes it.
        """
        if self.mapper.ended is not None:
            return self.mapper.ended
        current = self.mapper.time.current()
        if current.waited_s <= stuck_s and current.for_s <= ENDLESS_S:
            return None
        at, for_s = current.activity.value, current.for_s
        return f"mapping makes no progress: it is at {at} since {for_s:.0f} s"

    def problem(self) -> str | None:
        """Why the server does not do all that it should, ``None`` where it does.

        Beside :meth:`mapping_problem`: a store that cannot be written. A server that was started
        without one keeps no map, as it should.
        """
        mapping = self.mapping_problem()
        if mapping is not None or not self.checkpoints.has_store or self.checkpoints.error is None:
            return mapping
        return f"what is mapped is not kept: {self.checkpoints.error}"

    def summary(self) -> str:
        """What the server does, and what keeps it from that, in a line."""
        doing = (
            f"serving map '{self.map_name}': epoch {self.mapper.epochs.newest.number}, "
            f"{self.mapper.progress.scans_taken} scans taken"
        )
        problem = self.problem()
        return doing if problem is None else f"{doing}; {problem}"

    def report(self) -> dict[str, object]:
        """What a program that watches the server is told; ``problem`` is as :meth:`problem`."""
        epoch, progress = self.mapper.epochs.newest, self.mapper.progress
        return {
            "problem": self.problem(),
            "map": self.map_name,
            "server": self.server,
            "epoch": epoch.number,
            "settled": progress.settled and len(self.scans) == 0,
            "scans_taken": progress.scans_taken,
            "uptime_s": round(time.monotonic() - self.started_s, 3),
        }

    def _requests_refused(self) -> dict[str, int]:
        """Refused requests of all operations, by error code."""
        total: collections.Counter[str] = collections.Counter()
        for counts in self.operations.copy().values():
            total.update(counts.refused())
        return dict(total)


class Heartbeat:
    """Tells the network and the log how the server is doing, and keeps its memory small."""

    def __init__(self, session: zenoh.Session, health: Health) -> None:
        self._health = health
        # Not the priority of the replies: a publisher that drops, at the priority of one that
        # blocks, waits for the same slow client.
        self._publisher = session.declare_publisher(
            keys.status_key(health.map_name),
            encoding=keys.encoding(ServerStatus),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_LOW,
        )
        self._logged: ServerStatus | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat")
        self._thread.start()

    def close(self) -> None:
        """Stop publishing."""
        self._stopping.set()
        self._thread.join()
        self._publisher.undeclare()

    def _run(self) -> None:
        beat, trimmed_to = 0, resident_bytes()
        while not self._stopping.wait(STATUS_PERIOD_S):
            beat += 1
            if beat % _BEATS_PER_TRIM == 0 or resident_bytes() > trimmed_to + _TRIMMED_AT_BYTES:
                give_back_compiler()
                give_back_free()
                trimmed_to = resident_bytes()
            try:
                self._health.mapper.wake()  # for a sign of life, even where nothing is to do
                self._health.warnings.check()
                status = self._health.status()
                self._publisher.put(codec.encode(status))
            except Exception:
                _log.exception("the status could not be published")
                continue
            if beat % _BEATS_PER_LOG_LINE == 0:
                self._log_progress(status)

    def _log_progress(self, status: ServerStatus) -> None:
        """One line, where anything happened since the last one."""
        before, self._logged = self._logged, status
        if before is not None and _activity(before) == _activity(status):
            return
        _log.info(
            "epoch %d%s: %d scans taken, %d dropped, %d lost, %d waiting; "
            "%.1f M samples trained, loss %.4f; %d regions, %d vertices; %.0f MB",
            status.epoch,
            " (settled)" if status.settled else "",
            status.scans_taken,
            sum(status.scans_dropped.values()),
            sum(status.scans_lost.values()),
            status.scans_waiting,
            status.samples_trained / 1e6,
            status.loss,
            status.regions,
            status.vertices,
            status.memory_bytes / 1e6,
        )


def _activity(status: ServerStatus) -> tuple[object, ...]:
    return status.epoch, status.scans_taken, status.scans_dropped, status.scans_lost
