"""Fetching the map as a file."""

import hashlib
import os
import tempfile
from pathlib import Path
from typing import IO

from triquad_format import keys
from triquad_format.messages import MapChunk, MapChunkRequest, MapInfo, MapInfoRequest

from triquad_client.connection import Connection, Pending, in_flight, retried
from triquad_client.errors import DownloadError

_PREPARE_TIMEOUT_S = 120.0
"""The server writes the file before it answers."""


class MapDownload:
    """Map files; their chunks go in the background of everything else."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def fetch(self, path: Path, training: bool) -> MapInfo:
        """Write the newest map to ``path``, all of it or nothing.

        Raises:
            DownloadError: the bytes are not those the server announced.
        """
        # Newer map files may push this one out of the server: then the newest is taken.
        return retried("chunk_gone", lambda: self._fetch(path, training))

    def _fetch(self, path: Path, training: bool) -> MapInfo:
        info = self._connection.ask(
            keys.MAP_INFO,
            MapInfoRequest(training),
            MapInfo,
            background=True,
            timeout_s=max(self._connection.timeout_s, _PREPARE_TIMEOUT_S),
        )
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                self._write(info, file)
                file.flush()
                os.fsync(file.fileno())
            Path(name).chmod(0o644)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
        return info

    def _write(self, info: MapInfo, file: IO[bytes]) -> None:
        digest = hashlib.sha256()
        offsets = range(0, info.bytes, max(1, info.chunk_bytes))
        for chunk in in_flight(lambda offset: self._send(info.sha256, offset), offsets):
            if chunk.offset != file.tell():
                raise DownloadError(f"chunk at {chunk.offset} came in place of {file.tell()}")
            digest.update(chunk.data)
            file.write(chunk.data)
        if digest.hexdigest() != info.sha256:
            raise DownloadError(f"the file's SHA-256 is {digest.hexdigest()}, not {info.sha256}")

    def _send(self, sha256: str, offset: int) -> Pending[MapChunk]:
        request = MapChunkRequest(sha256, offset)
        return self._connection.send(keys.MAP_CHUNK, request, MapChunk, background=True)
