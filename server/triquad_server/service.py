"""The map server: its parts, wired to a Zenoh session."""

import secrets
from collections.abc import Callable
from types import TracebackType

import zenoh
from triquad_format import keys
from triquad_format.messages import (
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
)

from triquad_server.checkpoints import Checkpoints
from triquad_server.desk import RequestDesk
from triquad_server.download import MapDownloads
from triquad_server.flush import FlushDesk
from triquad_server.gate import QueryGate
from triquad_server.health import Counts, Health, Identity
from triquad_server.heartbeat import Heartbeat
from triquad_server.mapper import Mapper
from triquad_server.mapper_thread import MapperInputs, MapperThread
from triquad_server.requests import Resets, SdfQueries, TileQueries, answering
from triquad_server.scan_queue import ScanIntake, ScanQueue
from triquad_server.settings import Settings
from triquad_server.sources import SourceLedger
from triquad_server.store import Store
from triquad_server.tally import Tally


class Service:
    """Serves one map until it is closed."""

    def __init__(
        self,
        session: zenoh.Session,
        mapper: Mapper,
        map_name: str,
        settings: Settings,
        device: str,
        store: Store | None = None,
        restored: CheckpointInfo | None = None,
        failed: Callable[[], None] = lambda: None,
    ) -> None:
        """Serve ``mapper`` on an open ``session``; closing session and store is the caller's.

        Args:
            session: an open Zenoh session.
            mapper: the map; nothing else may use it from now on.
            map_name: the map's name in all keys.
            settings: each part takes its own section.
            device: where the mapper computes, for the status.
            store: where checkpoints go.
            restored: the checkpoint that ``mapper`` was restored from.
            failed: called where the service can go on no longer, by a defect.
        """
        limits = settings.service
        self._counts = Counts(Tally(), Tally(), Tally())
        self._gate = QueryGate()
        ledger = SourceLedger()
        scans = ScanQueue(limits.scan_queue, ledger, self._counts.scans_dropped)
        inputs = MapperInputs(
            scans, ledger, self._gate, self._counts.scans_dropped, self._counts.points_dropped
        )
        self._mapper = MapperThread(
            mapper, inputs, limits.publish_period_s, limits.epochs_kept, failed
        )
        self._checkpoints = Checkpoints(self._mapper, store, settings.store.period_s, restored)
        identity = Identity(map_name, secrets.token_hex(8), device)
        self._health = Health(
            identity, self._counts, ledger, scans, self._mapper, self._checkpoints
        )
        self._flush = FlushDesk(
            ledger, self._mapper.publish_soon, limits.flush_timeout_max_s, limits.request_queue
        )
        self._mapper.start()
        self._checkpoints.start()
        self._flush.start()
        self._intake = ScanIntake(
            session,
            map_name,
            limits.scan_queue,
            scans,
            self._counts.scans_dropped,
            self._mapper.wake,
        )
        self._desks = self._open_desks(session, map_name, settings)
        self._heartbeat = Heartbeat(session, map_name, self._health)
        self._token = session.liveliness().declare_token(
            keys.alive_key(map_name, identity.server),
        )

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
        self._token.undeclare()
        self._intake.close()
        self._mapper.rest()
        self._checkpoints.close()
        self._flush.close()
        for desk in self._desks:
            desk.close()
        self._heartbeat.close()
        self._mapper.close()

    def _open_desks(
        self,
        session: zenoh.Session,
        map_name: str,
        settings: Settings,
    ) -> list[RequestDesk]:
        """One desk per group of operations, so that none waits for a slower one."""
        limits = settings.service
        epochs = self._mapper.epochs
        sdf = SdfQueries(epochs, self._gate, limits.max_query_points)
        tiles = TileQueries(epochs, settings.mesh.tile_side_m)
        downloads = MapDownloads(self._mapper)
        resets = Resets(self._mapper)
        groups = [
            ({keys.SDF: answering(SdfRequest, sdf.answer)}, limits.query_workers),
            (
                {
                    keys.TILE_LIST: answering(TileListRequest, tiles.tiles),
                    keys.TILE: answering(TileRequest, tiles.tile),
                },
                1,
            ),
            (
                {
                    keys.STATUS: answering(StatusRequest, self._health.answer),
                    keys.FLUSH: lambda request: self._flush.hold(
                        request, request.read(FlushRequest)
                    ),
                },
                1,
            ),
            (
                {
                    keys.MAP_INFO: answering(MapInfoRequest, downloads.info),
                    keys.MAP_CHUNK: answering(MapChunkRequest, downloads.chunk),
                },
                1,
            ),
            (
                {
                    keys.CHECKPOINT: answering(CheckpointRequest, self._checkpoints.answer),
                    keys.RESET: answering(ResetRequest, resets.answer),
                },
                1,
            ),
        ]
        return [
            RequestDesk(
                session,
                map_name,
                operations,
                workers,
                limits.request_queue,
                self._counts.requests_refused,
            )
            for operations, workers in groups
        ]
