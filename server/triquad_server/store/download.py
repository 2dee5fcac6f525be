"""Serves map files that clients fetch in chunks."""

import io
from collections import deque
from contextlib import closing
from dataclasses import dataclass

from triquad_format.errors import RefusedError
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_format.wire.messages import MapChunk, MapChunkRequest, MapInfo, MapInfoRequest
from triquad_map.preview import previews_of

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.history import EpochHistory
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.process.memory_share import MemoryShare
from triquad_server.store.store import stamp_now_ns

CHUNK_BYTES = 2**20
FILES_KEPT = 2


@dataclass(frozen=True)
class _MapBytes:
    info: MapInfo
    training: bool
    data: bytes


class MapDownloads:
    """Serialises epochs on request; the files made last are kept."""

    def __init__(
        self,
        mapper: MapperThread,
        epochs: EpochHistory,
        memory: MemoryShare,
        server: str = "",
    ) -> None:
        """Make the handler; ``server`` is a name of the map here, which may take ``memory``."""
        self._memory = memory
        self._epochs = epochs
        self._server = server
        self._mapper = mapper
        self._files: deque[_MapBytes] = deque(maxlen=FILES_KEPT)

    def info(self, request: MapInfoRequest) -> MapInfo:
        """Return size and digest of the newest epoch's file, which is made unless it is there."""
        newest = self._epochs.newest
        self._check_size(newest)
        for file in tuple(self._files):
            if (file.info.epoch, file.training) == (newest.number, request.training):
                return file.info
        if request.training:
            record, newest = self._whole()
        else:
            record = newest.record()
        buffer, stamp_ns = io.BytesIO(), stamp_now_ns()
        previews = previews_of(record, newest, stamp_ns)
        written = write_map(record, buffer, stamp_ns=stamp_ns, previews=previews)
        info = MapInfo(
            epoch=written.epoch,
            bytes=written.bytes,
            sha256=written.sha256,
            chunk_bytes=CHUNK_BYTES,
            server=self._server,
        )
        self._files.append(_MapBytes(info, request.training, buffer.getvalue()))
        return info

    def _check_size(self, epoch: Epoch) -> None:
        """Raise :class:`RefusedError` for a map that is too large to be made a file in memory.

        In a file regions have a fourth of the bytes that they take while they are mapped.
        """
        cold = (one for one in epoch.frozen_regions if isinstance(one, ColdRegion))
        if sum(one.facts.memory_bytes for one in cold) > self._memory.limit:
            raise RefusedError(
                "too_large",
                "the map is larger than the server's memory has room for: make a file of it where "
                "its store is, by triquad-pack",
            )

    def _whole(self) -> tuple[MapRecord, Epoch]:
        """Return the map with its training state, and its epoch."""
        snapshot = self._mapper.call(lambda mapper: mapper.snapshot_since(None))
        epoch = snapshot.epoch
        cold = (one.whole() for one in epoch.frozen_regions if isinstance(one, ColdRegion))
        with closing(snapshot):
            return epoch.record((*snapshot.records(self._mapper.taken), *cold)), epoch

    def chunk(self, request: MapChunkRequest) -> MapChunk:
        """Return bytes of a file, at most ``CHUNK_BYTES``.

        Raises:
            RefusedError: the file is not kept, or the bytes do not lie in it.
        """
        found = (file for file in tuple(self._files) if file.info.sha256 == request.sha256)
        if (file := next(found, None)) is None:
            raise RefusedError("chunk_gone", "this map file is not kept; ask for its info again")
        if not 0 <= request.offset < len(file.data) or request.length < 1:
            raise RefusedError(
                "bad_request",
                f"{request.length} bytes from {request.offset} on are not in the file of "
                f"{len(file.data)} bytes",
            )
        end = request.offset + min(request.length, CHUNK_BYTES)
        return MapChunk(request.offset, file.data[request.offset : end])
