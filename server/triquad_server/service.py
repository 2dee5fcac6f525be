"""The map server: its parts, wired to a Zenoh session."""

import secrets
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType

import zenoh
from triquad_format.wire import keys
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    FlushRequest,
    MapChunkRequest,
    MapInfoRequest,
    ResetRequest,
    SdfRequest,
    StatusRequest,
    TileListRequest,
    TileRequest,
    TileUpdatesRequest,
)
from triquad_format.wire.query_messages import (
    AlignRequest,
    DistanceRequest,
    GridRequest,
    RaysRequest,
    SegmentsRequest,
    SpheresRequest,
)
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
from triquad_server.mesh.tile_cache import TileShelf
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.net.handlers import Handler, RequestDesk
from triquad_server.net.payload import payload_limit
from triquad_server.net.requests import TileQueries, answering
from triquad_server.settings import Settings
from triquad_server.store.checkpoints import Checkpoints
from triquad_server.store.download import MapDownloads
from triquad_server.store.store import Store
from triquad_server.threads import Teams

_TILE_WORKERS = 2  # one computes while another packs


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
        """Begin to serve; ``failed`` is called where mapping stops by a defect."""
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

    def __enter__(self) -> "Service":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def epoch(self) -> int:
        """Number of the newest epoch."""
        return self._mapper.epochs.newest.number

    def close(self) -> None:
        """Stop mapping, write a last checkpoint, and answer what still waits."""
        self._parts.close()

    def _open(self, failed: Callable[[], None]) -> None:
        self._mapper = self._open_mapper(failed)
        checkpoints = Checkpoints(
            self._mapper,
            self._served.store,
            self._settings.store.period_s,
            self._served.restored,
        )
        identity = Identity(self._served.name, secrets.token_hex(8), self._served.device)
        health = Health(
            identity,
            self._counts,
            self._ledger,
            self._scans,
            self._mapper,
            checkpoints,
        )
        self._open_desks(health, identity)
        checkpoints.start()
        self._parts.callback(checkpoints.close)
        # Closed before the last checkpoint is written: it shows every reset that was answered.
        self._open_admin_desk(checkpoints)
        self._parts.callback(self._mapper.rest)
        self._open_intake()
        self._parts.callback(Heartbeat(self._session, identity.map_name, health).close)
        token = self._session.liveliness().declare_token(
            keys.alive_key(identity.map_name, identity.server),
        )
        self._parts.callback(token.undeclare)

    def _open_mapper(self, failed: Callable[[], None]) -> MapperThread:
        inputs = MapperInputs(
            scans=self._scans,
            ledger=self._ledger,
            gate=self._gate,
            scans_dropped=self._counts.scans_dropped,
            points_dropped=self._counts.points_dropped,
        )
        limits = self._settings.service
        mapper = MapperThread(
            self._served.mapper,
            inputs,
            limits.publish_period_s,
            EpochLimits(limits.epochs_kept, limits.epochs_pinned, limits.pin_s),
            failed,
        )
        mapper.start()
        self._parts.callback(mapper.close)
        return mapper

    def _open_intake(self) -> None:
        intake = ScanIntake(
            self._session,
            self._served.name,
            self._settings.service.scan_queue,
            self._settings.scan.max_points,
            self._scans,
            self._counts.scans_dropped,
            self._mapper.wake,
        )
        self._parts.callback(intake.close)

    def _open_desks(self, health: Health, identity: Identity) -> None:
        """One desk per group of operations, so that none waits for a slower one."""
        self._open_question_desks()
        self._open_mesh_desks(identity)
        self._open_status_desk(health)
        downloads = MapDownloads(self._mapper)
        self._open_desk(
            {
                keys.MAP_INFO: answering(MapInfoRequest, downloads.info),
                keys.MAP_CHUNK: answering(MapChunkRequest, downloads.chunk),
            },
        )

    def _open_question_desks(self) -> None:
        limits = self._settings.service
        views = EpochViews(self._mapper.epochs, self._gate)
        answers = Answers(
            views.view, QuestionLimits(limits.max_query_points, limits.max_search_points)
        )
        self._open_desk({keys.SDF: answering(SdfRequest, answers.sdf)}, limits.query_workers)
        self._open_desk(
            {
                keys.DISTANCE: answering(DistanceRequest, answers.distance),
                keys.SPHERES: answering(SpheresRequest, answers.spheres),
            },
            limits.query_workers,
        )
        self._open_desk(
            {
                keys.SEGMENTS: answering(SegmentsRequest, answers.segments),
                keys.RAYS: answering(RaysRequest, answers.rays),
                keys.GRID: answering(GridRequest, answers.grid),
            },
            limits.query_workers,
        )
        self._open_desk({keys.ALIGN: answering(AlignRequest, answers.align)})

    def _open_mesh_desks(self, identity: Identity) -> None:
        shelf = TileShelf(self._settings.mesh, self._served.teams.meshing)
        tiles = TileQueries(self._mapper.epochs, shelf, self._settings.mesh)
        feed = TileFeed(
            shelf,
            self._mapper.epochs,
            self._gate,
            identity.server,
            self._settings.mesh,
            self._settings.service.request_queue,
        )
        feed.start()
        self._parts.callback(feed.close)
        self._open_desk(
            {
                keys.TILE_LIST: answering(TileListRequest, tiles.tiles),
                keys.TILE: answering(TileRequest, tiles.tile),
            },
            _TILE_WORKERS,
        )
        self._open_desk(
            {
                keys.TILE_UPDATES: lambda request: feed.hold(
                    request, request.read(TileUpdatesRequest)
                ),
            },
        )

    def _open_status_desk(self, health: Health) -> None:
        limits = self._settings.service
        flush = FlushHandler(
            self._ledger,
            self._mapper.publish_soon,
            limits.flush_timeout_max_s,
            limits.request_queue,
        )
        flush.start()
        self._parts.callback(flush.close)
        self._open_desk(
            {
                keys.STATUS: answering(StatusRequest, health.answer),
                keys.FLUSH: lambda request: flush.add(request, request.read(FlushRequest)),
            },
        )

    def _open_admin_desk(self, checkpoints: Checkpoints) -> None:
        resets = Resets(self._mapper)
        self._open_desk(
            {
                keys.CHECKPOINT: answering(CheckpointRequest, checkpoints.answer),
                keys.RESET: answering(ResetRequest, resets.answer),
            },
        )

    def _open_desk(self, operations: dict[str, Handler], workers: int = 1) -> None:
        limits = self._settings.service
        desk = RequestDesk(
            self._session,
            self._served.name,
            operations,
            workers,
            limits.request_queue,
            payload_limit(limits.max_query_points),
            self._counts.requests_refused,
        )
        self._parts.callback(desk.close)
