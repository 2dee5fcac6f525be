"""Serves map files that clients fetch in chunks."""

import io
from collections import deque
from dataclasses import dataclass

from triquad_format.errors import RefusedError
from triquad_format.mapfile.writer import write_map
from triquad_format.wire.messages import MapChunk, MapChunkRequest, MapInfo, MapInfoRequest
from triquad_map.preview import previews_of

from triquad_server.epochs.history import EpochHistory
from triquad_server.mapping.mapper_thread import MapperThread
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

    def __init__(self, mapper: MapperThread, epochs: EpochHistory, server: str = "") -> None:
        """Make the handler; ``server`` is a name of this process."""
        self._epochs = epochs
        self._server = server
        self._mapper = mapper
        self._files: deque[_MapBytes] = deque(maxlen=FILES_KEPT)

    def info(self, request: MapInfoRequest) -> MapInfo:
        """Return size and digest of the newest epoch's file, which is made unless it is there."""
        newest = self._epochs.newest
        for file in tuple(self._files):
            if (file.info.epoch, file.training) == (newest.number, request.training):
                return file.info
        if request.training:
            snapshot = self._mapper.call(lambda mapper: mapper.snapshot_since(None))
            record, newest = snapshot.record(), snapshot.epoch
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
