"""Fetching the map as a file; its chunks go in the background of everything else."""

import hashlib
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.index import check_range
from triquad_format.mapfile.writer import MapFileInfo, replacing, write_map
from triquad_format.records.crop import crop_record
from triquad_format.wire import keys
from triquad_format.wire.messages import MapChunk, MapChunkRequest, MapInfo, MapInfoRequest
from triquad_map.stored_map import StoredMap

from triquad_client import checks
from triquad_client.checks import Bounds
from triquad_client.errors import DownloadError
from triquad_client.net.call import Ask, Call, Run, ask, ask_each, offload, retried

_PREPARE_S = 120.0
"""The server writes the file before it answers."""

_BLOCK_BYTES = 2**23


def newest_file(training: bool) -> Call[MapInfo]:
    """The file of the newest epoch, which the server keeps for a while."""
    request = MapInfoRequest(training)
    return ask(Ask(keys.MAP_INFO, request, MapInfo, background=True, min_timeout_s=_PREPARE_S))


class RemoteBytes:
    """The bytes of one map file on the server; see :class:`RandomAccess`."""

    def __init__(self, run: Run, info: MapInfo) -> None:
        self.name = f"the map of epoch {info.epoch}"
        self.size = info.bytes
        self.bytes_read = 0
        self._run = run
        self._info = info

    def read(self, offset: int, length: int) -> bytes:
        """Exactly ``length`` bytes from ``offset`` on.

        Raises:
            DamagedMapFileError: the file does not have so many.
            RefusedError: ``chunk_gone``, where the server does not keep the file any more.
            DownloadError: other bytes came than were asked for.
        """
        check_range(offset, length, self.size)
        end = offset + length
        step = max(1, self._info.chunk_bytes)
        data = bytearray()
        for chunk in self._run(ask_each(range(offset, end, step), lambda at: self._ask(at, end))):
            if chunk.offset != offset + len(data):
                raise DownloadError(f"chunk at {chunk.offset} came, not {offset + len(data)}")
            data += chunk.data
        if len(data) != length:
            raise DownloadError(f"{len(data)} bytes came from {offset} on, not {length}")
        self.bytes_read += length
        return bytes(data)

    def close(self) -> None:
        """Nothing is held but the connection, which is not this object's."""

    def _ask(self, offset: int, end: int) -> Ask[MapChunk]:
        length = min(self._info.chunk_bytes, end - offset)
        request = MapChunkRequest(self._info.sha256, offset, length)
        return Ask(keys.MAP_CHUNK, request, MapChunk, background=True)


def fetch(path: Path, training: bool) -> Call[MapInfo]:
    """Write the newest map to ``path``, as ``Client.download_map``."""

    def job(run: Run) -> MapInfo:
        info = run(newest_file(training))
        remote = RemoteBytes(run, info)
        digest = hashlib.sha256()
        with replacing(path) as file:
            for offset in range(0, info.bytes, _BLOCK_BYTES):
                data = remote.read(offset, min(_BLOCK_BYTES, info.bytes - offset))
                digest.update(data)
                file.write(data)
            found = digest.hexdigest()
            if found != info.sha256:
                raise DownloadError(f"the file's SHA-256 is {found}, not {info.sha256}")
        return info

    # Newer map files may push this one out of the server: then the newest is taken.
    return retried("chunk_gone", lambda: offload(job))


def fetch_box(path: Path, bounds: Bounds) -> Call[MapFileInfo]:
    """Write what answers in the bounds, as ``Client.download_box``."""
    low, high = checks.finite_box(bounds)

    def job(run: Run) -> MapFileInfo:
        try:
            stored = StoredMap(RemoteBytes(run, run(newest_file(training=False))))
            record = crop_record(stored.box(low, high), low, high)
            if not record.has_evidence:
                raise DownloadError(
                    f"nothing of the map lies between {low.tolist()} and {high.tolist()}"
                )
            return write_map(record, path, stamp_ns=stored.manifest.stamp_ns or None)
        except FormatError as error:
            raise DownloadError(str(error)) from error

    return (yield from retried("chunk_gone", lambda: offload(job)))
