"""The map server: its parts, connected to a Zenoh session."""

import secrets
from collections.abc import Callable
from contextlib import ExitStack

import zenoh
from triquad_format.wire import keys
from triquad_format.wire.messages import Scan

from triquad_server.epochs.history import EpochHistory
from triquad_server.epochs.surface_history import CHANGES_KEPT, SurfaceHistory
from triquad_server.intake.rays import ScanRays
from triquad_server.intake.scan_queue import ScanIntake, ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.stop import Stop
from triquad_server.routes import answer_requests
from triquad_server.server_status import Health, Heartbeat
from triquad_server.serving.operations import Operations
from triquad_server.settings import Settings
from triquad_server.store.checkpoint_writer import CheckpointWriter
from triquad_server.store.store import Store


class Service:
    """Serves one map until it is closed; the caller closes session and store after it."""

    def __init__(
        self,
        session: zenoh.Session,
        mapper: Mapper,
        settings: Settings,
        store: Store | None = None,
        failed: Callable[[Stop], None] = lambda _: None,
        scans_of: str | None = None,
    ) -> None:
        """Begin to serve.

        Args:
            session: that clients reach.
            mapper: the map; nothing else may use it from now on.
            settings: of the service.
            store: of its checkpoints; ``None``: they are not kept.
            failed: called with the reason if an error ends mapping.
            scans_of: the map whose scans are taken; ``None``: this one's.
        """
        self.session = session
        self._scans_of = scans_of or mapper.name
        self._is_shared = scans_of is not None
        self._map = mapper
        self._store = store
        self._settings = settings
        self._scans = ScanQueue(settings.service.scan_queue, is_shared=self._is_shared)
        self._warnings = ScanWarnings(self._scans, settings)
        first = mapper.publish()
        self._epochs = EpochHistory(
            first,
            settings.service,
            older_bytes=lambda: min(settings.memory.epochs_bytes, mapper.memory.kept_bytes),
        )
        self.operations = Operations(
            session,
            mapper.name,
            settings.service,
            give_way=self._scans.give_way,
            origin=self._epochs.origin,
        )
        self._surface = SurfaceHistory(first, CHANGES_KEPT)
        self._name = secrets.token_hex(8)  # of this map, as this process has it
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
        self._parts.callback(self.operations.close)
        self.mapper = self._open_mapper(failed)
        checkpoints = CheckpointWriter(self.mapper, self._store, self._settings.store)
        self.health = health = Health(
            map_name=self._map.name,
            server=self._name,
            device=self._map.device,
            session=self.session,
            operations=self.operations,
            scans=self._scans,
            warnings=self._warnings,
            mapper=self.mapper,
            epochs=self._epochs,
            checkpoints=checkpoints,
            memory=self._map.memory,
        )
        tiles = TileCache(
            self._settings.mesh,
            self._map.teams.background,
            max_bytes=lambda: self._map.memory.kept_bytes,
        )
        self._count(tiles)
        checkpoints.start()
        self._parts.callback(checkpoints.close)
        answer_requests(health, tiles, self._surface, self._trails, is_shared=self._is_shared)
        # Closed before the last checkpoint is written: it contains every reset that was answered.
        self._parts.callback(self.operations.close)
        self._parts.callback(self.mapper.pause)
        self._open_intake()
        self._announce(health)
        self._parts.callback(self.operations.stop)  # before anything is waited for

    def _count(self, tiles: TileCache) -> None:
        """Have counted what takes memory."""
        memory = self._map.memory
        memory.add("map", lambda: self.mapper.progress.map.map_bytes)
        memory.add("older epochs", lambda: self._epochs.older_bytes)
        memory.add("mesh tiles", lambda: tiles.nbytes)
        memory.add("scans that wait", lambda: self._scans.nbytes)
        if self._store is not None:
            cache = self._store.regions.cache
            memory.add("regions read to answer", lambda: cache.bytes, cache.clear)

    def _announce(self, health: Health) -> None:
        """Say that the server is there, until it closes."""
        self._parts.callback(Heartbeat(self.session, health).close)
        if self._is_shared:
            return  # once it has its regions
        alive = keys.alive_key(health.map_name, health.server)
        self._parts.callback(self.session.liveliness().declare_token(alive).undeclare)

    def _open_mapper(self, failed: Callable[[Stop], None]) -> MapperThread:
        warnings, trails = self._warnings, self._trails
        mapper = MapperThread(
            self._map,
            self._scans,
            self._epochs,
            self._settings.service.publish_period_s,
            failed=failed,
            scan_taken=(warnings.add, trails.add),
            scan_learnt=self._keep_scan,
            published=self._surface.add,
        )
        mapper.start()
        self._parts.callback(mapper.close)
        return mapper

    def _keep_scan(self, scan: Scan, rays: ScanRays) -> None:
        if self._store is not None:
            self._store.scans.add(scan, rays)

    def _open_intake(self) -> None:
        intake = ScanIntake(
            self.session,
            self._scans_of,
            self._scans,
            max_points=self._settings.scan.max_points,
            arrived=self.mapper.wake,
        )
        self._parts.callback(intake.close)
