"""The map server: its parts, wired to a Zenoh session."""

import secrets
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

import zenoh
from triquad_format.wire import keys
from triquad_format.wire.messages import CheckpointInfo
from triquad_map.questions.answers import Answers, QuestionLimits

from triquad_server.counter import Counter
from triquad_server.epochs.gate import QueryGate
from triquad_server.epochs.history import EpochLimits
from triquad_server.epochs.views import EpochViews
from triquad_server.health import Counts, Health, Identity
from triquad_server.heartbeat import Heartbeat
from triquad_server.intake.flush import FlushHandler
from triquad_server.intake.scan_queue import ScanIntake, ScanQueue
from triquad_server.intake.sources import SourceLedger
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperInputs, MapperThread
from triquad_server.mapping.resets import Resets
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.mesh.tile_queries import TileQueries
from triquad_server.net.handlers import HandlerLimits, RequestHandlers
from triquad_server.net.request import payload_limit
from triquad_server.operations import (
    Operations,
    admin_operations,
    download_operations,
    mesh_operations,
    query_operations,
    status_operations,
)
from triquad_server.settings import Settings
from triquad_server.store.checkpoints import Checkpoints
from triquad_server.store.download import MapDownloads
from triquad_server.store.store import Store
from triquad_server.threads import Teams


@dataclass(frozen=True)
class ServedMap:
    """A map that is handed over to a service; nothing else may use it from then on."""

    name: str
    mapper: Mapper
    device: str  # where the mapper computes
    store: Store | None = None  # where its checkpoints go
    restored: CheckpointInfo | None = None  # the checkpoint it was restored from
    teams: Teams = field(default_factory=Teams)  # whose threads make mesh tiles


class Service:
    """Serves one map until it is closed. Session and store are closed by the caller, after."""

    def __init__(
        self,
        session: zenoh.Session,
        served: ServedMap,
        settings: Settings,
        failed: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin to serve; ``failed`` is called where mapping stops by an internal error."""
        self._session = session
        self._served = served
        self._settings = settings
        self._counts = Counts(Counter(), Counter(), Counter())
        self._gate = QueryGate()
        self._ledger = SourceLedger()
        self._scans = ScanQueue(
            settings.service.scan_queue,
            self._ledger,
            self._counts.scans_dropped,
        )
        self._parts = ExitStack()  # closed in reverse order of opening
        try:
            self._open(failed)
        except BaseException:
            self._parts.close()
            raise

    @property
    def epoch(self) -> int:
        """Number of the newest epoch."""
        return self._mapper.epochs.newest.number

    def close(self) -> None:
        """Stop mapping, write a last checkpoint, and answer what still waits."""
        self._parts.close()

    def _open(self, failed: Callable[[], None]) -> None:
        """Open the parts, in the reverse of the order in which they have to be closed."""
        identity = Identity(self._served.name, secrets.token_hex(8), self._served.device)
        self._mapper = self._open_mapper(failed)
        checkpoints = Checkpoints(
            self._mapper,
            self._served.store,
            self._settings.store.period_s,
            self._served.restored,
        )
        health = Health(
            identity, self._counts, self._ledger, self._scans, self._mapper, checkpoints
        )
        self._serve(*self._queries())
        self._serve(*mesh_operations(*self._open_mesh(identity.server)))
        self._serve(status_operations(health, self._open_flush()))
        self._serve(download_operations(MapDownloads(self._mapper)))
        checkpoints.start()
        self._parts.callback(checkpoints.close)
        # Closed before the last checkpoint is written: it shows every reset that was answered.
        self._serve(admin_operations(checkpoints, Resets(self._mapper)))
        self._parts.callback(self._mapper.rest)
        self._open_intake()
        self._parts.callback(Heartbeat(self._session, identity.map_name, health).close)
        alive = keys.alive_key(identity.map_name, identity.server)
        self._parts.callback(self._session.liveliness().declare_token(alive).undeclare)

    def _open_mapper(self, failed: Callable[[], None]) -> MapperThread:
        limits = self._settings.service
        mapper = MapperThread(
            self._served.mapper,
            MapperInputs(
                scans=self._scans,
                ledger=self._ledger,
                gate=self._gate,
                scans_dropped=self._counts.scans_dropped,
                points_dropped=self._counts.points_dropped,
            ),
            limits.publish_period_s,
            EpochLimits(limits.epochs_kept, limits.epochs_pinned, limits.pin_s),
            failed,
        )
        mapper.start()
        self._parts.callback(mapper.close)
        return mapper

    def _queries(self) -> list[Operations]:
        limits = self._settings.service
        views = EpochViews(self._mapper.epochs, self._gate)
        most = QuestionLimits(limits.max_query_points, limits.max_search_points)
        return query_operations(Answers(views.view, most), limits.query_workers)

    def _open_mesh(self, server: str) -> tuple[TileQueries, TileFeed]:
        cache = TileCache(self._settings.mesh, self._served.teams.meshing)
        feed = TileFeed(
            cache,
            self._mapper.epochs,
            self._gate,
            server=server,
            settings=self._settings.mesh,
            limit=self._settings.service.request_queue,
        )
        feed.start()
        self._parts.callback(feed.close)
        return TileQueries(self._mapper.epochs, cache, self._settings.mesh), feed

    def _open_flush(self) -> FlushHandler:
        limits = self._settings.service
        flush = FlushHandler(
            self._ledger,
            self._mapper.publish_soon,
            limits.flush_timeout_max_s,
            limits.request_queue,
        )
        flush.start()
        self._parts.callback(flush.close)
        return flush

    def _open_intake(self) -> None:
        intake = ScanIntake(
            self._session,
            self._served.name,
            limit=self._settings.service.scan_queue,
            max_points=self._settings.scan.max_points,
            queue=self._scans,
            dropped=self._counts.scans_dropped,
            arrived=self._mapper.wake,
        )
        self._parts.callback(intake.close)

    def _serve(self, *groups: Operations) -> None:
        """Answer operations from now on, until the service is closed."""
        limits = self._settings.service
        for group in groups:
            handlers = RequestHandlers(
                self._session,
                {keys.operation_key(self._served.name, o): h for o, h in group.handlers.items()},
                HandlerLimits(
                    workers=group.workers,
                    waiting=limits.request_queue,
                    request_bytes=payload_limit(limits.max_query_points),
                ),
                self._counts.requests_refused,
            )
            self._parts.callback(handlers.close)
