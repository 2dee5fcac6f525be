"""Depth images, from the client to what the map answers."""

from typing import Any

import numpy as np
import pytest
from support import servers
from triquad_client import Intrinsics, InvalidScanError, Status, depth_points

CAMERA = Intrinsics(fx=60.0, fy=50.0, cx=39.5, cy=29.5)
SHAPE = (60, 80)
FORWARD = np.array([[0.0, 0, 1, 5], [-1, 0, 0, 6], [0, -1, 0, 1.5], [0, 0, 0, 1]])
"""A camera at 5, 6, 1.5 that looks along x; its image's down is the map's."""


def wall_depth(distance_m: float = 4.0) -> np.ndarray:
    return np.full(SHAPE, distance_m, np.float32)


@pytest.mark.parametrize("units_per_metre", [None, 5000])
def test_a_wall_stands_where_the_camera_saw_it(units_per_metre: int | None) -> None:
    with servers.service_and_client() as client:
        depth = wall_depth()
        depth[:30, :40] = 0  # nothing is known of the upper left quarter
        if units_per_metre is not None:
            depth = (units_per_metre * depth).astype(np.uint16)
        client.publish_depth(depth, CAMERA, FORWARD, units_per_metre=units_per_metre)
        client.settle(servers.WAIT_S)
        # At x = 9; the image's right is towards -y, its down towards -z.
        asked = [[9, 5, 0.5], [9, 7, 0.5], [9, 5, 2.5], [9, 7, 2.5], [7, 5.5, 1]]
        surface, free, unknown = Status.SURFACE, Status.FREE, Status.UNKNOWN
        expected = [surface, surface, surface, unknown, free]
        assert client.query_sdf(asked).status.tolist() == expected
        places = [[9, 5 + 0.1 * step, 1.1] for step in range(20)]
        assert np.median(np.abs(client.query_sdf(places).sdf)) < 0.05


def test_pixels_are_projected_by_the_pinhole_model() -> None:
    depth = np.zeros(SHAPE)
    depth[12, 70], depth[50, 3] = 2.0, 5.0
    points = depth_points(depth, CAMERA)
    assert points.dtype == np.float32
    pixels = points[:, :2] / points[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    np.testing.assert_allclose(pixels, [[70, 12], [3, 50]], atol=1e-4)
    np.testing.assert_array_equal(points[:, 2], [2.0, 5.0])


def test_millimetres_and_metres_are_told_apart_by_their_type() -> None:
    metres = np.random.default_rng(1).uniform(0.5, 9, SHAPE)
    millimetres = np.round(1000 * metres).astype(np.uint16)
    np.testing.assert_allclose(
        depth_points(millimetres, CAMERA), depth_points(metres, CAMERA), atol=1e-3
    )


def test_what_shows_nothing_is_left_out_and_a_stride_thins() -> None:
    depth = wall_depth()
    depth[0, 0], depth[2, 2], depth[1, 1] = np.nan, np.inf, 0
    assert len(depth_points(depth, CAMERA)) == depth.size - 3
    assert len(depth_points(depth, CAMERA, np.int64(2))) == depth.size // 4 - 2  # type: ignore[arg-type]
    rep_117 = depth.copy()
    rep_117[1, 2:4] = -np.inf, -0.5
    assert len(depth_points(rep_117, CAMERA)) == depth.size - 5
    for kind in (np.uint16, np.uint32):
        millimetres = np.full(SHAPE, 2000, kind)
        millimetres[0, :2] = 0, np.iinfo(kind).max
        assert len(depth_points(millimetres, CAMERA)) == depth.size - 2
    thinned = depth_points(depth, CAMERA, stride=2)
    whole = depth_points(wall_depth(), CAMERA).reshape(*SHAPE, 3)
    np.testing.assert_array_equal(
        thinned, np.delete(whole[::2, ::2].reshape(-1, 3), [0, SHAPE[1] // 2 + 1], axis=0)
    )


def test_a_camera_matrix_gives_the_intrinsics() -> None:
    matrix = [[60, 0, 39.5], [0, 50, 29.5], [0, 0, 1]]
    assert Intrinsics.from_matrix(matrix) == CAMERA
    assert Intrinsics.from_matrix(np.ravel(matrix)) == CAMERA  # as CameraInfo has it
    for given in (matrix, np.array(matrix)):
        points = depth_points(wall_depth(), given)
        np.testing.assert_array_equal(points, depth_points(wall_depth(), CAMERA))


@pytest.mark.parametrize(
    ("depth", "stride", "text"),
    [
        (np.zeros((60, 80, 3)), 1, r"depth is \[60, 80, 3\], not \[rows, columns\]"),
        (np.zeros((0, 80)), 1, r"depth is \[0, 80\]"),
        (np.zeros(SHAPE), 1, "shows nothing"),
        (np.full(SHAPE, np.nan), 1, "shows nothing"),
        (np.full(SHAPE, -2.0), 1, "depth -2 m is negative"),
        (np.ones(SHAPE, np.uint8), 1, "depth is uint8: use floating metres, or millimetres"),
        (np.ones(SHAPE, int), 1, "depth is int64"),
        ("depth", 1, "depth is not an image of real numbers: 'depth'"),
        ([[1.0, 2.0], [3.0]], 1, "depth is not an image of real numbers: setting an array"),
        (np.ma.masked_equal(wall_depth(), 4.0), 1, "depth is .* some values are masked"),
        (np.ones((4, 4, 1)), 1, r"depth is \[4, 4, 1\]"),
        (np.ones(SHAPE), 0, "stride = 0: use a whole number"),
        (np.ones(SHAPE), 1.5, "stride = 1.5"),
    ],
)
def test_what_is_no_depth_image_is_refused(depth: Any, stride: Any, text: str) -> None:
    with pytest.raises(InvalidScanError, match=text):
        depth_points(depth, CAMERA, stride)


@pytest.mark.parametrize("units", ["1000", 0, -1.0, np.inf, np.nan])
def test_units_that_are_none_are_refused(units: Any) -> None:
    with pytest.raises(InvalidScanError, match=f"units_per_metre = {units!r}: use a number above"):
        depth_points(wall_depth(), CAMERA, units_per_metre=units)
    assert len(depth_points(wall_depth(), CAMERA, units_per_metre=2)) == np.prod(SHAPE)


@pytest.mark.parametrize(
    "values", [(0.0, 1, 1, 1), (1, -1, 1, 1), (1, 1, np.nan, 1), (1, np.inf, 1, 1)]
)
def test_what_is_no_camera_is_refused(values: tuple[float, ...]) -> None:
    with pytest.raises(InvalidScanError, match="intrinsics .*finite numbers, the first two"):
        Intrinsics(*values)


@pytest.mark.parametrize(
    ("matrix", "text"),
    [
        (np.eye(4), "size 16"),
        ("K", "'K' .* is not a real number"),
        ([[60, 1, 39], [0, 50, 29], [0, 0, 1]], "has a skew of 1, not 0; rectify the images"),
        (np.zeros((3, 3)), r"the last row \[0.0, 0.0, 0.0\], not \[0, 0, 1\]"),
        ([[60, 0, 0], [0, 50, 0], [39, 29, 1]], "the last row .* is it transposed?"),
    ],
)
def test_what_is_no_camera_matrix_is_refused(matrix: Any, text: str) -> None:
    with pytest.raises(InvalidScanError, match=f"camera matrix.*{text}"):
        Intrinsics.from_matrix(matrix)
