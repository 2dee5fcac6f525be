"""Fetching the map as a file; its chunks go in the background of everything else."""

import hashlib
import shutil
from contextlib import closing
from pathlib import Path

from triquad_format.errors import InvalidInputError, MapFileError
from triquad_format.mapfile.container import is_map
from triquad_format.mapfile.files import FileBytes, check_range, replacing
from triquad_format.wire.messages import MapChunkRequest, MapInfo, MapInfoRequest

from triquad_client import checks
from triquad_client.errors import DownloadError
from triquad_client.net.connection import Connection, new_ticket, retried

_BLOCK_BYTES = 2**23
_PACKED_S = 600.0  # the time in which a server packs its map, at most


def map_target(path: str | Path) -> Path:
    """Return the file to which a map is to be written: only an older map may be there.

    Raises:
        OSError: what is there cannot be read.
    """
    if not isinstance(path, str | Path) or Path(path).is_dir():
        raise InvalidInputError(f"path = {checks.shown(path)} is no file: give the name of one")
    try:
        with closing(FileBytes(Path(path))) as file:
            is_older_map = is_map(file)
    except FileNotFoundError:
        is_older_map = True  # nothing to lose
    except MapFileError:
        is_older_map = False  # a device
    if not is_older_map:
        raise InvalidInputError(
            f"{path} is there, and is no map of triquad: give another name, or delete it first"
        )
    return Path(path)


def newest_file(connection: Connection, training: bool = False) -> MapInfo:
    """Return the file of the newest epoch, which the server keeps for a while.

    Raises:
        DownloadError: it is larger than this client takes.
    """
    request = MapInfoRequest(training, new_ticket())
    info, max_bytes = connection.ask_until_done(request, _PACKED_S), connection.max_download_bytes
    if info.bytes > max_bytes:
        raise DownloadError(
            f"the server announces a map file of {info.bytes} bytes, more than the {max_bytes} "
            "that this client takes: connect with a larger max_download_bytes if that is right"
        )
    return info


class RemoteBytes:
    """The bytes of one map file on the server; see :class:`RandomAccess`."""

    def __init__(self, connection: Connection, info: MapInfo) -> None:
        """Open a file that the server keeps for a while."""
        self.name = f"the map of epoch {info.epoch}"
        self.size = info.bytes
        self.bytes_read = 0
        self._connection = connection
        self._info = info
        self._max_bytes = connection.max_download_bytes

    def read(self, offset: int, length: int) -> bytes:
        """Return exactly ``length`` bytes from ``offset`` on.

        Raises:
            DamagedMapFileError: the file does not have as many.
            RefusedError: ``chunk_gone``, where the server does not keep the file any more.
            DownloadError: it is too much in all.
        """
        check_range(offset, length, self.size)
        if self.bytes_read + length > self._max_bytes:
            raise DownloadError(f"{self.name} names more than {self._max_bytes} bytes to be read")
        end = offset + length
        starts = range(offset, end, self._info.chunk_bytes)
        chunks = self._connection.replies(self._request(at, end) for at in starts)
        data = b"".join(chunk.data for chunk in chunks)
        self.bytes_read += length
        return data

    def close(self) -> None:
        """Do nothing: only the connection is open, which is not this object's."""

    def _request(self, offset: int, end: int) -> MapChunkRequest:
        length = min(self._info.chunk_bytes, end - offset)
        return MapChunkRequest(self._info.sha256, offset, length)


class DownloadCalls:
    """The calls that fetch the map, or a part of it, as a file."""

    _connection: Connection

    def download_map(self, path: str | Path, training: bool = False) -> MapInfo:
        """Write the newest map to a file, checked against its digest, all of it or nothing.

        Args:
            path: the file; an older map is replaced, and nothing else.
            training: with the state from which training can go on.

        Raises:
            InvalidInputError: the file is there, and is not a triquad map.
            DownloadError: what arrived is not what the server announced.
            OSError: the file cannot be written.
        """
        training, target = checks.flag("training", training), map_target(path)
        # Newer map files may push this one out of the server: then the newest is used.
        return retried("chunk_gone", lambda: _fetch(self._connection, target, training))


def _fetch(connection: Connection, path: Path, training: bool) -> MapInfo:
    info = newest_file(connection, training)
    _check_space(path, info.bytes)
    remote = RemoteBytes(connection, info)
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


def _check_space(path: Path, size: int) -> None:
    """Refuse a file for which the disk has no room, before any of it is sent.

    Raises:
        DownloadError: there is not as much.
        OSError: there is no such folder.
    """
    free = shutil.disk_usage(path.parent).free
    if size > free:
        raise DownloadError(f"{path} would take {size} bytes, and {free} are free on its disk")
