"""A map file on the server, of which only the bytes that are asked for travel."""

from triquad_format.mapfile.files import check_range
from triquad_format.wire import keys
from triquad_format.wire.messages import MapChunk, MapChunkRequest, MapInfo

from triquad_client.errors import DownloadError
from triquad_client.net.call import Ask, Run, ask_each


class RemoteBytes:
    """The bytes of one map file on the server, as :class:`RandomAccess` of map files gives them."""

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
