"""Tiles of replies, from the bytes in which they came."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from triquad_format.errors import WireError
from triquad_format.records.arrays import Longs
from triquad_format.wire.tile_codec import TileSurface, decode_tile, decoded_bytes

from triquad_client.errors import BadReplyError, DownloadError


class DecodedTile(NamedTuple):
    """A tile, and what it was decoded from."""

    data: bytes
    surface: TileSurface


class TileDecoder:
    """Decodes tiles, which take a given memory and no more, in however many replies they come."""

    def __init__(self, max_bytes: int, kept_bytes: int = 0) -> None:
        """Decode up to ``max_bytes``, of which others take ``kept_bytes`` already."""
        self._max_bytes = max_bytes
        self._taken = kept_bytes

    def decode(self, sizes: Longs, data: bytes) -> Iterator[DecodedTile]:
        """Yield tiles whose ``sizes`` [T] in bytes add up to ``data``, one after the other.

        Raises:
            BadReplyError: they are not valid.
            DownloadError: all take more than they may.
        """
        for size, end in zip(sizes.tolist(), np.cumsum(sizes).tolist(), strict=True):
            part = data[end - size : end]
            try:
                self._taken += decoded_bytes(part)  # before any of it is made
                if self._taken > self._max_bytes:
                    raise DownloadError(
                        f"the mesh takes more than {self._max_bytes} bytes: ask for a smaller box "
                        "or a coarser level, or connect with a larger max_download_bytes"
                    )
                yield DecodedTile(part, decode_tile(part))
            except WireError as error:
                raise BadReplyError(f"a tile of the reply: {error}") from error
