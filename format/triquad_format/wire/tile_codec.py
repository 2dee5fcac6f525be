"""The compact form of a mesh tile, as ``docs/wire-protocol.md`` specifies it.

Every vertex lies on an edge of the tile's lattice, so it is a lattice point, an axis and a byte
that says how far along the edge it is. Neighbouring tiles of a level name vertices on their common
face by the same edge and the same byte: they meet exactly.
"""

import struct
from dataclasses import dataclass

import numpy as np
import zstandard
from numpy.typing import NDArray

from triquad_format.errors import WireError

STEPS = 255
"""Parts into which an edge of the lattice is divided."""

MAX_CELLS = 256
"""Cells along the side of a tile, at most."""

_HEADER = struct.Struct("<II")  # vertices, faces
_MAX_COUNT = 1 << 25
_VERTEX_BYTES = 8  # three coordinates of two bytes, the axis, the step
_LEVEL = 3
"""The level of zstandard: 9 makes 6 % less of it, and takes twice and a half the time in all."""


@dataclass(frozen=True)
class TileSurface:
    """Triangles of a tile, on its lattice."""

    points: NDArray[np.uint16]  # [V, 3] lower lattice point of the edge on which each vertex lies
    axes: NDArray[np.uint8]  # [V] axis of the edge
    steps: NDArray[np.uint8]  # [V] how far along it, in parts of STEPS
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from free space

    def positions(self, cell_m: float) -> NDArray[np.float32]:
        """Return the vertices [V, 3], metres from the tile's minimum corner."""
        places = self.points.astype(np.float64)
        places[np.arange(len(places)), self.axes] += self.steps / STEPS
        return (places * cell_m).astype(np.float32)


def encode_tile(surface: TileSurface) -> bytes:
    """Return the bytes of a tile; vertices MUST be numbered in the order of first use by faces.

    The same surface always gives the same bytes.
    """
    flat = surface.faces.ravel().astype(np.int64)
    # How far each corner lies behind the next new vertex: 0 is that vertex itself.
    known = np.maximum.accumulate(np.concatenate([[-1], flat]))[:-1] + 1 if len(flat) else flat
    behind = (known - flat).astype(np.uint32)
    moves = np.diff(surface.points, axis=0, prepend=np.zeros((1, 3), np.uint16))
    zigzag = _zigzag(moves.astype(np.int16))
    body = _planes(zigzag.T) + surface.axes.tobytes() + surface.steps.tobytes() + _planes(behind)
    header = _HEADER.pack(len(surface.points), len(surface.faces))
    return header + zstandard.ZstdCompressor(level=_LEVEL).compress(body)


def decoded_bytes(data: bytes) -> int:
    """Return how many bytes a tile's positions and faces will take, from its header alone.

    Raises:
        WireError: these are not the bytes of a tile.
    """
    return sum(_counts(data)) * 12


def decode_tile(data: bytes) -> TileSurface:
    """Invert :func:`encode_tile`.

    Raises:
        WireError: these are not the bytes of a tile.
    """
    vertices, faces = _counts(data)
    size = vertices * _VERTEX_BYTES + faces * 12
    body = np.frombuffer(_decompressed(data[_HEADER.size :], size), np.uint8)
    planes, rest = np.split(body, [vertices * 6])
    axes, steps, codes = np.split(rest, [vertices, 2 * vertices])
    zigzag = _joined(planes.reshape(2, 3 * vertices), "<u2").reshape(3, vertices).T
    points = np.cumsum(_unzigzag(zigzag), axis=0, dtype=np.uint16)
    behind = _joined(codes.reshape(4, 3 * faces), "<u4").astype(np.int64)
    is_new = behind == 0
    flat = np.cumsum(is_new) - is_new - behind
    if (
        (flat < 0).any()
        or int(is_new.sum()) != vertices
        or (axes > 2).any()
        or (points > MAX_CELLS).any()
    ):
        raise WireError("a tile's vertices and faces do not fit together")
    return TileSurface(points, axes, steps, faces=flat.astype(np.int32).reshape(-1, 3))


def _counts(data: bytes) -> tuple[int, int]:
    """Return vertices and faces, as the header has them."""
    if len(data) < _HEADER.size:
        raise WireError(f"a tile of {len(data)} bytes has no header")
    vertices, faces = _HEADER.unpack_from(data)
    if max(vertices, faces) > _MAX_COUNT:
        raise WireError(f"a tile of {vertices} vertices and {faces} faces is too large")
    return vertices, faces


def _decompressed(data: bytes, size: int) -> bytes:
    """Return a zstd frame's content, which must be ``size`` bytes."""
    try:
        declared = zstandard.frame_content_size(data)
        if declared != size:
            raise WireError(f"a tile's frame declares {declared} bytes, not {size}")
        return zstandard.ZstdDecompressor().decompress(data) if size else b""
    except zstandard.ZstdError as error:
        raise WireError(f"a tile's bytes: {error}") from error


def _zigzag(values: NDArray[np.int16]) -> NDArray[np.uint16]:
    """Return small numbers of either sign as small numbers: 0, -1, 1, -2 become 0, 1, 2, 3."""
    return ((values << 1) ^ (values >> 15)).astype(np.uint16)


def _unzigzag(values: NDArray[np.uint16]) -> NDArray[np.int16]:
    return ((values >> 1).astype(np.int16)) ^ -((values & 1).astype(np.int16))


def _planes(values: NDArray[np.unsignedinteger]) -> bytes:
    """Return the lowest byte of each value, then the next of each, and so on."""
    little = values.astype(values.dtype.newbyteorder("<"), copy=False)
    planes: bytes = little.reshape(-1, 1).view(np.uint8).T.tobytes()
    return planes


def _joined(planes: NDArray[np.uint8], dtype: str) -> NDArray[np.unsignedinteger]:
    """Return the values of byte planes [B, N]."""
    return np.frombuffer(np.ascontiguousarray(planes.T).tobytes(), dtype)
