"""Mesh tiles as Draco bytes, where the library is installed: https://google.github.io/draco/.

Positions are quantised relative to the tile's cube, with 0 and the largest number on its faces,
so that neighbouring tiles meet as exactly as they do in :mod:`triquad_format.wire.tile_codec`.
"""

import numpy as np
from numpy.typing import NDArray

from triquad_format.errors import WireError

try:
    import DracoPy
except ImportError:
    DracoPy = None

AVAILABLE = DracoPy is not None
"""Whether Draco can be spoken here."""

_BITS = 14  # as fine as the steps of tile_code in a tile of 64 cells
_COMPRESSION = 7  # of 10; slower ones gain 3 %


def encode_draco(
    positions: NDArray[np.float32], faces: NDArray[np.int32], side_m: float
) -> bytes | None:
    """The bytes of a tile of side ``side_m``; None where Draco cannot hold its faces.

    The same tile always gives the same bytes.
    """
    try:
        data: bytes = DracoPy.encode(
            positions,
            faces,
            quantization_bits=_BITS,
            compression_level=_COMPRESSION,
            quantization_range=side_m,
            quantization_origin=[0.0, 0.0, 0.0],
        )
    except (ValueError, RuntimeError, DracoPy.EncodingFailedException):
        return None
    return data


def decode_draco(data: bytes) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices [V, 3], metres from the tile's minimum corner, and faces [F, 3].

    Raises:
        WireError: these are not the bytes of a tile, or Draco is not installed.
    """
    if DracoPy is None:
        raise WireError(
            "a tile came as Draco, which is not installed: pip install 'triquad[draco]'"
        )
    try:
        mesh = DracoPy.decode(data)
        positions = np.asarray(mesh.points, np.float32).reshape(-1, 3)
        faces = np.asarray(mesh.faces).reshape(-1, 3).astype(np.int32)
    except (ValueError, RuntimeError, AttributeError, DracoPy.FileTypeException) as error:
        raise WireError(f"a tile's Draco bytes: {error}") from error
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(positions):
        raise WireError("a tile's Draco faces name vertices that are not there")
    return positions, faces
