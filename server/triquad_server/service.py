"""The map server: its parts, connected to a Zenoh session."""

import secrets
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

import zenoh
from triquad_format.wire import keys
from triquad_format.wire.limits import MAX_QUERY_POINTS, payload_limit
from triquad_format.wire.mesh_messages import MeshRequest, TileChangesRequest, TileListRequest
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    FlushRequest,
    MapChunkRequest,
    MapInfoRequest,
    ResetRequest,
    StatusRequest,
)
from triquad_format.wire.metrics_messages import MetricsRequest
from triquad_format.wire.query_messages import ChangesRequest, GridRequest
from triquad_format.wire.source_messages import SourcesRequest
from triquad_map.questions.answers import QUESTIONS, Answers

from triquad_server.epochs.history import EpochHistory
from triquad_server.epochs.surface_history import CHANGES_KEPT, SurfaceHistory, changes_reply
from triquad_server.intake.scan_queue import ScanIntake, ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapListeners, MapperThread
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_queries import TileQueries
from triquad_server.process.stop import Stop
from triquad_server.process.threads import Teams
from triquad_server.server_status import Health, Heartbeat
from triquad_server.serving.operations import Lane, Operations
from triquad_server.settings import Settings
from triquad_server.store.checkpoint_writer import CheckpointWriter
from triquad_server.store.download import MapDownloads
from triquad_server.store.scrub import Scrubber
from triquad_server.store.store import Store


@dataclass(frozen=True)
class ServedMap:
    """A map that is handed over to a service; nothing else may use it from then on."""

    name: str
    mapper: Mapper
    device: str  # device of the mapper
    store: Store | None = None  # store of its checkpoints
    restored: CheckpointInfo | None = None  # checkpoint that it was restored from
    teams: Teams = field(default_factory=Teams)  # teams that make mesh tiles


class Service:
    """Serves one map until it is closed; the caller closes session and store after it."""

    def __init__(
        self,
        session: zenoh.Session,
        served: ServedMap,
        settings: Settings,
        failed: Callable[[Stop], None] = lambda _: None,
    ) -> None:
        """Begin to serve; ``failed`` is called with the reason if an error ends mapping."""
        self.session = session
        self._served = served
        self._settings = settings
        self._scans = ScanQueue(settings.service.scan_queue)
        self._operations = Operations(
            session,
            served.name,
            settings.service,
            give_way=self._scans.give_way,
            origin=lambda: self._mapper.origin,
        )
        self._warnings = ScanWarnings(self._scans, settings)
        first = served.mapper.publish()
        self._epochs = EpochHistory(
            first, settings.service, older_bytes=settings.memory.epochs_bytes
        )
        self._surface = SurfaceHistory(first, CHANGES_KEPT)
        self._name = secrets.token_hex(8)  # of this process
        self._trails = SourceTrails(first.field_settings.leaf_m, self._name)
        self._parts = ExitStack()  # closed in reverse order of opening
        try:
            self._open(failed)
        except BaseException:
            self._parts.close()
            raise

    @property
    def epoch(self) -> int:
        """The number of the newest epoch."""
        return self._epochs.newest.number

    def close(self) -> None:
        """Refuse pending requests, stop mapping, and write a last checkpoint.

        Raises:
            StoreError: the checkpoint cannot be written; all else is closed.
        """
        self._parts.close()

    def _open(self, failed: Callable[[Stop], None]) -> None:
        """Open the parts, in the reverse of the order in which they have to be closed."""
        self._parts.callback(self._operations.close)
        self._mapper = self._open_mapper(failed)
        checkpoints = CheckpointWriter(
            self._mapper,
            self._served.store,
            period_s=self._settings.store.period_s,
            last=self._served.restored,
        )
        self.health = health = Health(
            map_name=self._served.name,
            server=self._name,
            device=self._served.device,
            session=self.session,
            operations=self._operations,
            scans=self._scans,
            warnings=self._warnings,
            mapper=self._mapper,
            epochs=self._epochs,
            checkpoints=checkpoints,
            map_max_bytes=self._settings.memory.max_bytes,
        )
        tiles = TileCache(self._settings.mesh, self._served.teams.background)
        downloads = MapDownloads(self._mapper, self._epochs, health.server)
        self._open_checkpoints(checkpoints)
        self._serve(tiles, downloads)
        # Closed before the last checkpoint is written: it contains every reset that was answered.
        self._parts.callback(self._operations.close)
        self._parts.callback(self._mapper.pause)
        self._open_intake()
        self._announce(health)
        self._parts.callback(self._operations.stop)  # before anything is waited for

    def _open_checkpoints(self, checkpoints: CheckpointWriter) -> None:
        """Begin to write and check checkpoints."""
        checkpoints.start()
        self._parts.callback(checkpoints.close)
        store, scrub_h = self._served.store, self._settings.store.scrub_h
        if store is not None and scrub_h > 0:
            scrubber = Scrubber(store.folder, scrub_h, damaged=checkpoints.found_damaged)
            self._parts.callback(scrubber.close)

    def _serve(self, tiles: TileCache, downloads: MapDownloads) -> None:
        """Answer the requests of clients from now on."""
        serve, health = self._operations.serve, self.health
        answers, max_bytes = Answers(self._epochs.view), payload_limit(MAX_QUERY_POINTS)
        for question in QUESTIONS:
            lane = Lane.LONG_QUESTIONS if question is GridRequest else Lane.QUESTIONS
            serve(question, answers.answer, lane, max_bytes)
        mesh = TileQueries(self._epochs, tiles, health.server)
        serve(
            ChangesRequest,
            lambda request: changes_reply(
                request, self._surface, self._epochs.newest, health.server
            ),
        )
        serve(SourcesRequest, self._trails.answer)
        serve(TileListRequest, mesh.tiles, Lane.MESH)
        serve(TileChangesRequest, mesh.changes, Lane.MESH)
        serve(MeshRequest, mesh.mesh, Lane.MESH)
        serve(MapChunkRequest, downloads.chunk, Lane.LONG_QUESTIONS)

        ledger, soon, warnings = self._scans.ledger, self._mapper.publish_soon, self._warnings.of
        lane = Lane.ADMINISTRATION
        serve(StatusRequest, lambda _: health.status(), lane)
        serve(MetricsRequest, lambda _: health.metrics(), lane)
        serve(FlushRequest, lambda request: ledger.answer(request, soon, warnings), lane)

        checkpoints, trails = health.checkpoints, self._trails
        serve(CheckpointRequest, checkpoints.answer, Lane.FILES)
        serve(ResetRequest, lambda request: checkpoints.reset(request, trails), Lane.FILES)
        serve(MapInfoRequest, downloads.info, Lane.FILES)

    def _announce(self, health: Health) -> None:
        """Say that the server is there, until it closes."""
        self._parts.callback(Heartbeat(self.session, health).close)
        alive = keys.alive_key(health.map_name, health.server)
        self._parts.callback(self.session.liveliness().declare_token(alive).undeclare)

    def _open_mapper(self, failed: Callable[[Stop], None]) -> MapperThread:
        warnings, trails, store = self._warnings, self._trails, self._served.store
        log = None if store is None else store.scans
        mapper = MapperThread(
            self._served.mapper,
            self._scans,
            self._epochs,
            self._settings.service.publish_period_s,
            failed=failed,
            listeners=MapListeners(
                scan_taken=(
                    lambda scan, rays: warnings.add(
                        scan.source, scan.points, rays, stamp_ns=scan.stamp_ns
                    ),
                    trails.add,
                    *(() if log is None else (log.add,)),
                ),
                published=(self._surface.add,),
            ),
        )
        mapper.start()
        self._parts.callback(mapper.close)
        return mapper

    def _open_intake(self) -> None:
        intake = ScanIntake(
            self.session,
            self._served.name,
            self._scans,
            max_points=self._settings.scan.max_points,
            arrived=self._mapper.wake,
        )
        self._parts.callback(intake.close)
