"""The server's status, put together from its parts."""

import time
from dataclasses import dataclass

import triquad_format
from triquad_format.wire.messages import ServerStatus, StatusRequest

from triquad_server.counter import Counter
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.sources import SourceLedger
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.memory import resident_bytes
from triquad_server.store.checkpoints import Checkpoints


@dataclass(frozen=True)
class Identity:
    """Which server this is."""

    map_name: str
    server: str  # a name of this process
    device: str


@dataclass(frozen=True)
class Counts:
    """What the server counts."""

    scans_dropped: Counter
    points_dropped: Counter
    requests_refused: Counter


class Health:
    """Knows how the server is doing."""

    def __init__(
        self,
        identity: Identity,
        counts: Counts,
        ledger: SourceLedger,
        scans: ScanQueue,
        mapper: MapperThread,
        checkpoints: Checkpoints,
    ) -> None:
        self._identity = identity
        self._counts = counts
        self._ledger = ledger
        self._scans = scans
        self._mapper = mapper
        self._checkpoints = checkpoints
        self._started = time.monotonic()

    def answer(self, _request: StatusRequest) -> ServerStatus:
        """The status on request."""
        return self.status()

    def status(self) -> ServerStatus:
        """The status now."""
        epoch = self._mapper.epochs.newest
        progress = self._mapper.progress
        return ServerStatus(
            map_name=self._identity.map_name,
            server=self._identity.server,
            version=triquad_format.__version__,
            device=self._identity.device,
            epoch=epoch.number,
            settled=progress.settled and len(self._scans) == 0,
            scans_taken=progress.scans_taken,
            scans_dropped=self._counts.scans_dropped.counts(),
            scans_lost=self._ledger.lost(),
            scans_waiting=len(self._scans),
            points_dropped=self._counts.points_dropped.counts(),
            requests_refused=self._counts.requests_refused.counts(),
            samples_trained=progress.samples_trained,
            rays_kept=progress.rays_kept,
            loss=float(progress.loss),
            regions=epoch.regions,
            vertices=epoch.vertices,
            parameters=epoch.parameters,
            memory_bytes=resident_bytes(),
            uptime_s=time.monotonic() - self._started,
            last_checkpoint=self._checkpoints.last,
            store_error=self._checkpoints.error,
        )
