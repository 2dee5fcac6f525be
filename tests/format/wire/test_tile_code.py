import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_format.errors import WireError
from triquad_format.wire.tile_codec import MAX_CELLS, TileSurface, decode_tile, encode_tile


def surface(seed: int, vertices: int) -> TileSurface:
    """Random triangles, whose vertices are numbered as they come."""
    rng = np.random.default_rng(seed)
    corners = rng.integers(0, max(1, vertices), 3 * vertices)
    _, first, inverse = np.unique(corners, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    count = len(first)
    return TileSurface(
        rng.integers(0, MAX_CELLS + 1, (count, 3)).astype(np.uint16),
        rng.integers(0, 3, count).astype(np.uint8),
        rng.integers(0, 256, count).astype(np.uint8),
        order[inverse.ravel()].astype(np.int32).reshape(-1, 3),
    )


def same(left: TileSurface, right: TileSurface) -> bool:
    return all(
        np.array_equal(getattr(left, name), getattr(right, name))
        and getattr(left, name).dtype == getattr(right, name).dtype
        for name in ("points", "axes", "steps", "faces")
    )


@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_round_trip(seed: int, vertices: int) -> None:
    tile = surface(seed, vertices)
    assert same(decode_tile(encode_tile(tile)), tile)


def one_triangle() -> TileSurface:
    points = np.array([[0, 1, 2], [64, 1, 2], [0, 63, 2]], np.uint16)
    axes, steps = np.array([0, 1, 2], np.uint8), np.array([51, 0, 255], np.uint8)
    return TileSurface(points, axes, steps, np.array([[0, 1, 2]], np.int32))


def test_where_vertices_are() -> None:
    expected = [[0.1 * 0.2, 0.1, 0.2], [6.4, 0.1, 0.2], [0, 6.3, 0.3]]
    np.testing.assert_allclose(one_triangle().positions(0.1), expected, atol=1e-6)


def test_the_bytes_are_those_of_the_specification() -> None:
    data = encode_tile(one_triangle())
    import zstandard

    assert data[:8] == bytes([3, 0, 0, 0, 1, 0, 0, 0])
    body = zstandard.ZstdDecompressor().decompress(data[8:])
    assert body == bytes(
        [0, 128, 127, 2, 0, 124, 4, 0, 0, *[0] * 9]  # moves of x, y, z: low bytes, high bytes
        + [0, 1, 2]  # axes
        + [51, 0, 255]  # steps
        + [0] * 12  # three new vertices
    )


@given(st.integers(0, 2**32 - 1))
def test_damaged_bytes_are_refused_or_read_but_never_do_harm(seed: int) -> None:
    data = bytearray(encode_tile(surface(5, 40)))
    rng = np.random.default_rng(seed)
    for position in rng.integers(0, len(data), 3):
        data[position] = rng.integers(0, 256)
    try:
        tile = decode_tile(bytes(data))
    except WireError:
        return
    assert tile.faces.max(initial=0) < max(1, len(tile.points))
    tile.positions(0.1)


def with_header(vertices: int, faces: int) -> bytes:
    header = np.array([vertices, faces], "<u4").tobytes()
    return header + encode_tile(one_triangle())[8:]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"1234567",
        with_header(2**32 - 1, 1),
        with_header(3, 2**26),
        with_header(4, 1),
        with_header(3, 1)[:-1],
        with_header(3, 1)[:8],
    ],
)
def test_hostile_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(WireError, match="tile"):
        decode_tile(data)
