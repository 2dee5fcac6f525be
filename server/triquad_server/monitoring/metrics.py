"""The server in figures: put together from its parts when somebody asks."""

import time
from dataclasses import dataclass

import numpy as np
import zenoh
from triquad_format.wire.metrics_messages import QueueMetrics, ServerMetrics

from triquad_server.array_memory import bytes_by_part
from triquad_server.epochs.epoch import Epoch
from triquad_server.health import Health
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.net.operation_counts import BOUNDS_S
from triquad_server.process.memory import resident_bytes
from triquad_server.queries.served_operations import ReadQueue
from triquad_server.store.download import MapDownloads

_MAX_SESSIONS = 1024  # that are listed


@dataclass(frozen=True)
class Metrics:
    """Knows the figures of a server."""

    health: Health
    session: zenoh.Session
    tiles: TileCache
    downloads: MapDownloads
    queues: dict[str, ReadQueue]  # of requests, by name

    def now(self) -> ServerMetrics:
        """The figures as they are now."""
        health, mapper = self.health, self.health.mapper
        kept = mapper.epochs.kept()
        return ServerMetrics(
            server=health.server,
            uptime_s=time.monotonic() - health.started_s,
            problem=health.problem(),
            epoch=kept.epochs[-1].number,
            epoch_age_s=kept.newest_age_s,
            epochs_kept=len(kept.epochs),
            epochs_pinned=kept.pinned,
            bounds_s=np.array(BOUNDS_S),
            operations={
                name: counts.metrics() for name, counts in health.operations.copy().items()
            },
            queues=self._queues(),
            sources=health.scans.ledger.sources(),
            scans_received=health.scans.received,
            scan_bytes_received=health.scans.received_bytes,
            memory_bytes=self._memory_bytes(kept.epochs),
            resident_bytes=resident_bytes(),
            mapper_s=mapper.time.spent_s(),
            checkpoints=health.checkpoints.metrics(),
            sessions=self._sessions(),
            scans_taken=mapper.progress.own_scans_taken,
            samples_trained=mapper.progress.own_samples_trained,
        )

    def _queues(self) -> dict[str, QueueMetrics]:
        scans = self.health.scans
        return {
            "scans": QueueMetrics(len(scans), scans.limit),
            **{name: read() for name, read in self.queues.copy().items()},
        }

    def _memory_bytes(self, epochs: tuple[Epoch, ...]) -> dict[str, int]:
        """What parts of the server take; memory that epochs and the live map share is the epochs'.

        The live map is as of the newest epoch: where training went on since, its copy of the
        features is in no part.
        """
        health = self.health
        regions = [region for epoch in epochs for region in epoch.frozen_regions]
        frozen = {
            "epochs": [(region.engine, region.evidence) for region in regions],
            "surfels": [region.surfels for region in regions],
        }
        live = dict.fromkeys(("field", "evidence", "replay_pools"), 0)
        for region in epochs[-1].frozen_regions:
            for part, size in region.live_bytes.items():
                live[part] += size
        return {
            **live,
            **bytes_by_part(frozen),
            "normals": health.mapper.progress.normals_bytes,
            "surface_history": health.mapper.surface.nbytes,
            "tile_cache": self.tiles.nbytes,
            "downloads": self.downloads.nbytes,
            "scan_queue": health.scans.bytes_waiting,
        }

    def _sessions(self) -> dict[str, str]:
        transports = self.session.info.transports()[:_MAX_SESSIONS]
        # Not the whole id: whoever knows it can ask in the name of another.
        return {str(transport.zid)[:8]: str(transport.whatami) for transport in transports}
