"""The map server: its parts, connected to a Zenoh session."""

import secrets
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

import zenoh
from triquad_format.wire import keys
from triquad_format.wire.codec import Message
from triquad_format.wire.limits import MAX_KNOWN_TILES, MAX_QUERY_POINTS, payload_limit
from triquad_format.wire.mesh_messages import MeshRequest, TileListRequest
from triquad_format.wire.messages import (
    CheckpointInfo,
    CheckpointRequest,
    MapChunkRequest,
    MapInfoRequest,
    ResetRequest,
    Scan,
    SdfRequest,
    StatusRequest,
)
from triquad_format.wire.metrics_messages import MetricsRequest
from triquad_format.wire.query_messages import (
    AlignRequest,
    ChangesRequest,
    DistanceRequest,
    GridRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
    SourcesRequest,
    SpheresRequest,
)
from triquad_map.questions.answers import Answers, QuestionLimits

from triquad_server.epochs.history import EpochHistory
from triquad_server.epochs.surface_history import CHANGES_KEPT, SurfaceHistory
from triquad_server.health import Health, Heartbeat
from triquad_server.intake.flush import FlushHandler
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.scan import ScanIntake
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapListeners, MapperThread
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.mesh.tile_queries import TileQueries
from triquad_server.monitoring.metrics import Metrics
from triquad_server.process.threads import Teams
from triquad_server.queries.change_queries import ChangeQueries
from triquad_server.queries.source_queries import SourceQueries
from triquad_server.serving.operations import Lane, Operations, answering
from triquad_server.settings import Settings
from triquad_server.store.checkpoint_thread import CheckpointThread
from triquad_server.store.download import MapDownloads
from triquad_server.store.resets import Resets
from triquad_server.store.scrub import Scrubber
from triquad_server.store.store import Store

_QUESTIONS: dict[str, type[Message]] = {
    keys.SDF: SdfRequest,
    keys.DISTANCE: DistanceRequest,
    keys.SPHERES: SpheresRequest,
    keys.SEGMENTS: SegmentsRequest,
    keys.RAYS: RaysRequest,
    keys.GROUND: GroundRequest,
    keys.GRID: GridRequest,
    keys.ALIGN: AlignRequest,
}
_QUESTION_BYTES = payload_limit(MAX_QUERY_POINTS)
_TILE_UPDATES_BYTES = 20 * MAX_KNOWN_TILES + 16_384  # 20 bytes of each known tile


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
        failed: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin to serve; ``failed`` is called if mapping stops by an internal error."""
        self._session = session
        self._served = served
        self._settings = settings
        self._scans = ScanQueue(settings.service.scan_queue)
        self._operations = Operations(
            session, served.name, settings.service, give_way=self._scans.give_way
        )
        self._warnings = ScanWarnings(self._scans, settings)
        first = served.mapper.publish()
        self._epochs = EpochHistory(
            first, settings.service, older_bytes=settings.memory.epochs_bytes
        )
        self._surface = SurfaceHistory(first, CHANGES_KEPT)
        self._trails = SourceTrails(first.field_settings.leaf_m)
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

    @property
    def own_name(self) -> str:
        """The name of the server in requests to itself."""
        return self._operations.own_name

    def close(self) -> None:
        """Refuse pending requests, stop mapping, and write a last checkpoint.

        Raises:
            StoreError: the checkpoint cannot be written; all else is closed.
        """
        self._parts.close()

    def _open(self, failed: Callable[[], None]) -> None:
        """Open the parts, in the reverse of the order in which they have to be closed."""
        self._parts.callback(self._operations.close)
        self._mapper = self._open_mapper(failed)
        checkpoints = CheckpointThread(
            self._mapper,
            self._served.store,
            period_s=self._settings.store.period_s,
            last=self._served.restored,
        )
        self.health = health = Health(
            map_name=self._served.name,
            server=secrets.token_hex(8),
            device=self._served.device,
            operations=self._operations.counts,
            scans=self._scans,
            warnings=self._warnings,
            mapper=self._mapper,
            epochs=self._epochs,
            checkpoints=checkpoints,
            map_max_bytes=self._settings.memory.max_bytes,
        )
        self._serve_queries()
        self._serve_changes(health.server)
        self._serve_sources(health.server)
        tiles = self._serve_mesh(health.server)
        downloads = self._serve_downloads(health.server)
        self.metrics = Metrics(
            health,
            self._session,
            self._surface,
            tiles=tiles,
            downloads=downloads,
            queues=self._operations.queues,
        )
        self._serve_status()
        self._open_checkpoints(checkpoints)
        # Closed before the last checkpoint is written: it contains every reset that was answered.
        self._parts.callback(self._operations.close)
        self._parts.callback(self._mapper.pause)
        self._open_intake()
        self._announce(health)
        self._parts.callback(self._operations.stop)  # before anything is waited for

    def _open_checkpoints(self, checkpoints: CheckpointThread) -> None:
        """Begin to write and check checkpoints, and serve what clients may ask of them."""
        checkpoints.start()
        self._parts.callback(checkpoints.close)
        store, scrub_h = self._served.store, self._settings.store.scrub_h
        if store is not None and scrub_h > 0:
            scrubber = Scrubber(store.folder, scrub_h, damaged=checkpoints.found_damaged)
            self._parts.callback(scrubber.close)
        resets = Resets(
            self._mapper,
            checkpoints,
            keep_resets=self._settings.store.keep_resets,
            trails=self._trails,
        )
        self._operations.serve(
            keys.CHECKPOINT, answering(CheckpointRequest, checkpoints.answer), Lane.SLOW
        )
        self._operations.serve(keys.RESET, answering(ResetRequest, resets.answer), Lane.SLOW)

    def _announce(self, health: Health) -> None:
        """Say that the server is there, until it closes."""
        self._parts.callback(Heartbeat(self._session, health).close)
        alive = keys.alive_key(health.map_name, health.server)
        self._parts.callback(self._session.liveliness().declare_token(alive).undeclare)

    def _open_mapper(self, failed: Callable[[], None]) -> MapperThread:
        mapper = MapperThread(
            self._served.mapper,
            self._scans,
            self._epochs,
            self._settings.service.publish_period_s,
            failed=failed,
            listeners=MapListeners(
                scan_taken=(self._add_to_warnings, self._trails.add),
                published=(self._surface.add,),
            ),
        )
        mapper.start()
        self._parts.callback(mapper.close)
        return mapper

    def _add_to_warnings(self, scan: Scan, rays: ScanRays) -> None:
        self._warnings.add(scan.source, len(scan.points), rays)

    def _open_intake(self) -> None:
        intake = ScanIntake(
            self._session,
            self._served.name,
            self._scans,
            max_points=self._settings.scan.max_points,
            arrived=self._mapper.wake,
        )
        self._parts.callback(intake.close)

    def _serve_queries(self) -> None:
        answers = Answers(self._epochs.view, QuestionLimits())
        for name, kind in _QUESTIONS.items():
            self._operations.serve(name, answering(kind, answers.answer), max_bytes=_QUESTION_BYTES)

    def _serve_changes(self, server: str) -> None:
        queries = ChangeQueries(self._epochs, self._surface, server)
        self._operations.serve(keys.CHANGES, answering(ChangesRequest, queries.changes))

    def _serve_sources(self, server: str) -> None:
        queries = SourceQueries(self._trails, server)
        self._operations.serve(keys.SOURCES, answering(SourcesRequest, queries.sources))

    def _serve_mesh(self, server: str) -> TileCache:
        """Serve queries of mesh tiles, and requests that follow them; return the cache."""
        cache = TileCache(self._settings.mesh, self._served.teams.meshing)
        feed = TileFeed(
            cache,
            self._epochs,
            server=server,
            limit=self._settings.service.request_queue,
        )
        self._parts.callback(feed.close)
        tiles = TileQueries(self._epochs, cache)
        self._operations.serve(keys.TILE_LIST, answering(TileListRequest, tiles.tiles))
        self._operations.serve(keys.MESH, answering(MeshRequest, tiles.mesh))
        self._operations.serve(
            keys.TILE_UPDATES, feed.add, Lane.ADMINISTRATION, max_bytes=_TILE_UPDATES_BYTES
        )
        self._operations.queues["mesh_followers"] = lambda: feed.queue
        return cache

    def _serve_status(self) -> None:
        """Publish the server's status, and answer whether scans are in the map."""
        flush = FlushHandler(
            self._scans.ledger,
            self._mapper.publish_soon,
            limit=self._settings.service.request_queue,
            warnings=self._warnings.of,
        )
        self._parts.callback(flush.close)
        self._operations.queues["flushes"] = lambda: flush.queue
        for name, handler in {
            keys.STATUS: answering(StatusRequest, lambda _: self.metrics.health.status()),
            keys.METRICS: answering(MetricsRequest, lambda _: self.metrics.now()),
            keys.FLUSH: flush.add,
        }.items():
            self._operations.serve(name, handler, Lane.ADMINISTRATION)

    def _serve_downloads(self, server: str) -> MapDownloads:
        downloads = MapDownloads(self._mapper, self._epochs, server)
        self._operations.serve(keys.MAP_INFO, answering(MapInfoRequest, downloads.info), Lane.SLOW)
        self._operations.serve(keys.MAP_CHUNK, answering(MapChunkRequest, downloads.chunk))
        return downloads
