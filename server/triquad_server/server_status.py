"""Reports the server's status, published once a second, its figures, and whether it works."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
import triquad_format
import zenoh
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import moved
from triquad_format.wire.metrics_messages import QueueMetrics, ServerMetrics
from triquad_format.wire.status_messages import ServerStatus

from triquad_server.epochs.history import EpochHistory
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.process.memory_share import MemoryShare
from triquad_server.process.resources import give_back_free, resident_bytes
from triquad_server.serving.operations import Operations
from triquad_server.serving.request import BOUNDS_S
from triquad_server.store.checkpoint_writer import CheckpointWriter

_log = logging.getLogger(__name__)

STATUS_PERIOD_S = 1.0
STUCK_S = 120.0  # longer waits of the mapper's thread are a fault
ENDLESS_S = 1800.0  # longer than the checkpoint of a large map takes

_BEATS_PER_LOG_LINE = 5
_NEARLY_FULL = 0.8  # of the memory that there may be: what is free is returned to the system
_MAX_SESSIONS = 1024  # that are listed


@dataclass(frozen=True)
class Health:
    """Collects the status and the figures of the server from its parts."""

    map_name: str
    server: str  # a name of this map, as this process has it
    device: str
    session: zenoh.Session
    operations: Operations
    scans: ScanQueue
    warnings: ScanWarnings
    mapper: MapperThread
    epochs: EpochHistory
    checkpoints: CheckpointWriter
    memory: MemoryShare
    # These give warnings of their own, such as of regions that cannot be taken.
    warned_by: list[Callable[[], Iterable[str]]] = field(default_factory=list)
    started_s: float = field(default_factory=time.monotonic)  # monotonic

    def status(self) -> ServerStatus:
        """Return the status now; its places count from the map's origin."""
        epoch = self.epochs.newest
        progress = self.mapper.progress
        refused: Counter[str] = Counter()  # of all operations, by error code
        for counts in self.operations.counts.copy().values():
            refused.update(counts.metrics().refused)
        return ServerStatus(
            map_name=self.map_name,
            server=self.server,
            version=triquad_format.__version__,
            device=self.device,
            epoch=epoch.number,
            settled=progress.settled and len(self.scans) == 0,
            scans_dropped=dict(self.scans.dropped),
            scans_lost=self.scans.ledger.lost(),
            scans_waiting=len(self.scans),
            points_dropped=dict(self.scans.points_dropped),
            requests_refused=dict(refused),
            loss=float(progress.loss),
            regions=epoch.regions,
            vertices=epoch.vertices,
            parameters=epoch.parameters,
            memory_bytes=resident_bytes(),
            uptime_s=time.monotonic() - self.started_s,
            last_checkpoint=self.checkpoints.last,
            store_error=self.checkpoints.error,
            kept_scans=self.checkpoints.kept_scans,
            correcting=self.checkpoints.correcting,
            warnings=(
                *filter(None, [self.checkpoints.warning]),
                *chain.from_iterable(warned() for warned in self.warned_by),
                *self.warnings.all(),
            ),
            map_max_bytes=self.memory.server.limit,
            memory_parts=self._memory_parts(),
            regions_cold=epoch.cold_regions,
            fit=progress.fit,
            origin_m=epoch.origin,
            region_pitch_m=epoch.field_settings.region_pitch_m,
            **vars(progress.map),
        )

    def _memory_parts(self) -> dict[str, int]:
        """Return what takes the memory; the rest is what is in work, or free between the others."""
        parts = self.memory.parts()
        return {**parts, "rest": max(0, resident_bytes() - sum(parts.values()))}

    def metrics(self) -> ServerMetrics:
        """Return the figures as they are now."""
        kept, scans = self.epochs.kept(), self.scans
        transports = self.session.info.transports()[:_MAX_SESSIONS]
        return ServerMetrics(
            server=self.server,
            uptime_s=time.monotonic() - self.started_s,
            problem=self.problem(),
            epoch=kept.epochs[-1].number,
            epoch_age_s=kept.newest_age_s,
            epochs_kept=len(kept.epochs),
            epochs_pinned=kept.pinned,
            bounds_s=np.array(BOUNDS_S),
            operations={name: one.metrics() for name, one in self.operations.counts.copy().items()},
            queues={
                "scans": QueueMetrics(len(scans), scans.limit),
                **self.operations.queue_metrics,
            },
            sources=scans.ledger.metrics(),
            scan_bytes_received=scans.received_bytes,
            resident_bytes=resident_bytes(),
            mapper_s=self.mapper.time.spent_s(),
            checkpoints=self.checkpoints.metrics(),
            # Not the whole id: a program that knows it can ask in the name of that client.
            sessions={str(one.zid)[:8]: str(one.whatami) for one in transports},
            samples_trained=self.mapper.progress.own_samples_trained,
        )

    def mapping_problem(self, stuck_s: float = STUCK_S) -> str | None:
        """Return why nothing is mapped any more until a restart; ``None`` if mapping works.

        A thread that computes counts as alive, for :data:`ENDLESS_S` at most; one that waits does
        if the :class:`Heartbeat`, which wakes it, reaches it.
        """
        if self.mapper.ended is not None:
            return self.mapper.ended
        current = self.mapper.time.current()
        if current.waited_s <= stuck_s and current.for_s <= ENDLESS_S:
            return None
        at, for_s = current.activity.value, current.for_s
        return f"mapping makes no progress: it is at {at} since {for_s:.0f} s"

    def stuck(self, longest_s: float) -> str | None:
        """Return what is at the same work for longer than ``longest_s``: mapping, or a question."""
        mapping = self.mapping_problem(min(STUCK_S, longest_s))
        if mapping is not None:
            return mapping
        for_s = self.operations.longest_question_s
        if for_s <= longest_s:
            return None
        return f"a question gets no answer: a worker is at it since {for_s:.0f} s"

    def problem(self) -> str | None:
        """Return why the server does not do all that it should; ``None`` if it does.

        That is :meth:`mapping_problem`, or a store that cannot be written.
        """
        mapping = self.mapping_problem()
        if mapping is not None or self.checkpoints.store is None or self.checkpoints.error is None:
            return mapping
        return f"what is mapped is not kept: {self.checkpoints.error}"

    def summary(self) -> str:
        """Return a line on what the server does, and what keeps it from that."""
        doing = (
            f"serving map '{self.map_name}': epoch {self.epochs.newest.number}, "
            f"{self.mapper.progress.map.scans_taken} scans taken"
        )
        problem = self.problem()
        return doing if problem is None else f"{doing}; {problem}"


class Heartbeat:
    """Publishes the server's status on the network, and logs it."""

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
        self._logged: tuple[object, ...] = ()  # what the last line reported
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat")
        self._thread.start()

    def close(self) -> None:
        """Stop publishing."""
        self._stopping.set()
        self._thread.join()
        self._publisher.undeclare()

    def _run(self) -> None:
        beat = 0
        while not self._stopping.wait(STATUS_PERIOD_S):
            beat += 1
            try:
                self._health.mapper.wake()  # as a sign of life, even where there is nothing to do
                self._health.warnings.check()
                status = self._health.status()
                self._publisher.put(codec.encode(moved(status, self._health.epochs.origin())))
            except MemoryError:
                _log.error("the status could not be published: there is no memory")
                continue
            except Exception:
                _log.exception("the status could not be published")
                continue
            if beat % _BEATS_PER_LOG_LINE == 0:
                if status.settled or status.memory_bytes > _NEARLY_FULL * status.map_max_bytes:
                    give_back_free()
                self._log_progress(status)

    def _log_progress(self, status: ServerStatus) -> None:
        """Log a line, if anything happened since the last one."""
        dropped, lost = sum(status.scans_dropped.values()), sum(status.scans_lost.values())
        now = (status.epoch, status.scans_taken, dropped, lost)
        if now != self._logged:
            self._logged = now
            several = len(self._health.memory.server.shares) > 1
            _log.info(
                "%sepoch %d%s: %d scans taken, %d dropped, %d lost, %d waiting; %.1f M samples "
                "trained, loss %.4f; %d regions, %d vertices; %.0f MB",
                f"map '{status.map_name}': " if several else "",
                *(status.epoch, " (settled)" if status.settled else ""),
                *(status.scans_taken, dropped, lost, status.scans_waiting),
                *(status.samples_trained / 1e6, status.loss, status.regions, status.vertices),
                status.memory_bytes / 1e6,
            )
