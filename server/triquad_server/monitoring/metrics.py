"""The server in figures: collected from its parts when a client or a scrape asks."""

import time
from dataclasses import dataclass

import numpy as np
import zenoh
from triquad_format.wire.metrics_messages import QueueMetrics, ServerMetrics

from triquad_server.epochs.array_memory import bytes_by_part
from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.surface_history import SurfaceHistory
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.memory import resident_bytes
from triquad_server.server_status import Health
from triquad_server.serving.operations import Operations
from triquad_server.serving.request import BOUNDS_S
from triquad_server.store.download import MapDownloads

_MAX_SESSIONS = 1024  # that are listed


@dataclass(frozen=True)
class Metrics:
    """Collects the figures of a server."""

    health: Health
    session: zenoh.Session
    surface: SurfaceHistory
    tiles: TileCache
    downloads: MapDownloads
    operations: Operations

    def now(self) -> ServerMetrics:
        """Return the figures as they are now."""
        health, mapper, scans = self.health, self.health.mapper, self.health.scans
        kept = health.epochs.kept()
        transports = self.session.info.transports()[:_MAX_SESSIONS]
        return ServerMetrics(
            server=health.server,
            uptime_s=time.monotonic() - health.started_s,
            problem=health.problem(),
            epoch=kept.epochs[-1].number,
            epoch_age_s=kept.newest_age_s,
            epochs_kept=len(kept.epochs),
            epochs_pinned=kept.pinned,
            bounds_s=np.array(BOUNDS_S),
            operations={name: one.metrics() for name, one in health.operations.copy().items()},
            queues={
                "scans": QueueMetrics(len(scans), scans.limit),
                **self.operations.queue_metrics,
            },
            sources=scans.ledger.metrics(),
            scan_bytes_received=scans.received_bytes,
            memory_bytes=self._memory_bytes(kept.epochs),
            resident_bytes=resident_bytes(),
            mapper_s=mapper.time.spent_s(),
            checkpoints=health.checkpoints.metrics(),
            # Not the whole id: a program that knows it can ask in the name of that client.
            sessions={str(one.zid)[:8]: str(one.whatami) for one in transports},
            samples_trained=mapper.progress.own_samples_trained,
        )

    def _memory_bytes(self, epochs: tuple[Epoch, ...]) -> dict[str, int]:
        """Return the bytes of each part; what epochs and the live map share is the epochs'.

        The live map is as of the newest epoch: where training went on since, its copy of the
        features is in no part.
        """
        regions = [region for epoch in epochs for region in epoch.frozen_regions]
        live = dict.fromkeys(("field", "evidence", "replay_pools"), 0)
        for region in epochs[-1].frozen_regions:
            for part, size in region.live_bytes.items():
                live[part] += size
        frozen = {
            "epochs": [(region.engine, region.evidence) for region in regions],
            "surfels": [region.surfels for region in regions],
        }
        mapper = self.health.mapper
        return {
            **live,
            **bytes_by_part(frozen),
            "normals": mapper.progress.map.normals_bytes,
            "surface_history": self.surface.nbytes,
            "tile_cache": self.tiles.nbytes,
            "downloads": self.downloads.nbytes,
            "scan_queue": self.health.scans.bytes_waiting,
        }
