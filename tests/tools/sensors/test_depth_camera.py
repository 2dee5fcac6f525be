"""Depth images of ROS."""

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from support.ros_messages import IMAGE, RosMessages
from triquad_tools.sensors.ros.depth_camera import camera_topic, sweep_of_depth
from triquad_tools.sensors.ros.from_bytes import decode_cdr
from triquad_tools.sensors.sweep import NoScanError

ROS = RosMessages()
MATRIX = np.array([[500.0, 0, 3], [0, 400.0, 2], [0, 0, 1]])
INFO = ROS.camera_info((4, 6), MATRIX, 7)


@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_pixels_become_points_of_the_optical_frame(encoding: str, order: str) -> None:
    depth = np.full((4, 6), 2.0)
    depth[0, 0] = 0
    kind = "f4" if encoding == "32FC1" else "u2"
    pixels = (depth if kind == "f4" else depth * 1000).astype(order + kind)
    message = ROS.image(pixels, encoding, 7)
    message.is_bigendian = int(order == ">")
    sweep = sweep_of_depth(decode_cdr(ROS.encode(message, IMAGE), IMAGE), INFO)
    assert (sweep.frame, sweep.stamp_ns) == ("optical", 7)
    assert sweep.points.shape == (23, 3)
    assert np.allclose(sweep.points[0], [(1 - 3) / 500 * 2, -2 / 400 * 2, 2])


def test_rows_may_be_padded() -> None:
    pixels = np.full((4, 8), 1000, np.uint16)
    pixels[:, 6:] = 5
    message = ROS.image(pixels, "16UC1", 7)
    message.width = 6
    assert (sweep_of_depth(message, INFO).points[:, 2] == 1.0).all()


def test_units_may_be_others_and_millimetres_are_told_from_metres() -> None:
    whole = ROS.image(np.full((4, 6), 8000, np.uint16), "16UC1", 7)
    assert np.allclose(sweep_of_depth(whole, INFO, units_per_metre=4000).points[:, 2], 2)
    floating = ROS.image(np.full((4, 6), 2000.0, np.float32), "32FC1", 7)
    assert np.allclose(sweep_of_depth(floating, INFO, units_per_metre=1000).points[:, 2], 2)
    with pytest.raises(NoScanError, match=r"more than 2000 m.*REP 118.*--units-per-metre 1000"):
        sweep_of_depth(floating, INFO)
    near = ROS.image(np.full((4, 6), 300.0, np.float32), "32FC1", 7)  # 30 cm, on a table
    with pytest.raises(NoScanError, match=r"more than 300 m"):
        sweep_of_depth(near, INFO)
    assert sweep_of_depth(near, INFO, units_per_metre=1).points[0, 2] == 300, "as it is said"


def compressed(pixels: np.ndarray, form: str, header: bytes) -> Any:
    return ROS.compressed_depth(pixels, 7, form, header)


def test_compressed_depth_is_read_as_image_transport_writes_it() -> None:
    raw = np.arange(24, dtype=np.uint16).reshape(4, 6) * 1000
    header = struct.pack("<iff", 1, 100.0, 2.0)
    for form, before, metres in (
        ("16UC1; compressedDepth png", header, raw / 1000),
        ("16UC1; compressedDepth", header, raw / 1000),
        ("16UC1; png compressed ", b"", raw / 1000),
        ("32FC1; compressedDepth png", header, 100.0 / (raw - 2.0)),
    ):
        sweep = sweep_of_depth(compressed(raw, form, before), INFO)
        assert np.allclose(sweep.points[:, 2], metres.ravel()[1:])
    assert camera_topic("/cam/depth/image_rect_raw/compressedDepth") == "/cam/depth/camera_info"
    for message, text in (
        (compressed(raw, "16UC1; compressedDepth rvl", header), "'image_transport republish'"),
        (compressed(raw, "16UC1; compressedDepth png", b""), "no PNG of depth"),
        (compressed(raw[:, :5], "16UC1; compressedDepth png", header), "5 x 4 pixels"),
    ):
        with pytest.raises(NoScanError, match=text):
            sweep_of_depth(message, INFO)


SIZE = (48, 64)
LENS = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])


def with_lens(model: str, values: Sequence[float]) -> Any:
    info = ROS.camera_info(SIZE, LENS, 7)
    info.distortion_model, info.d = model, np.array(values)
    info.p = np.array([30, 0, 31.5, 0, 0, 30, 23.5, 0, 0, 0, 1, 0.0])  # of the rectified image
    return info


def seen(model: str, d: Sequence[float], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Where a lens sees rays, by the formulas of OpenCV's documentation."""
    r2 = x**2 + y**2
    if model == "equidistant":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        factor = (angle + sum(k * angle ** (2 * n + 3) for n, k in enumerate(d))) / r
        return np.stack([x * factor, y * factor])
    k1, k2, p1, p2, k3, k4, k5, k6 = [*d, *[0] * 8][:8]
    scale = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.stack(
        [
            x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * scale + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ]
    )


@pytest.mark.parametrize(
    ("model", "values"),
    [
        ("plumb_bob", [-0.28, 0.07, 0.001, -0.002, 0.01]),
        ("plumb_bob", [0.5, -2.6, 0.0, 0.0, 1.4]),  # whose polynomial falls in the corners
        ("rational_polynomial", [0.5, -0.2, 0.001, 0.0003, 0.02, 0.9, -0.1, 0.05]),
        ("equidistant", [-0.02, 0.01, -0.003, 0.0005]),
    ],
)
def test_the_distortion_of_a_lens_is_taken_out(model: str, values: Sequence[float]) -> None:
    image = ROS.image(np.full(SIZE, 2.0, np.float32), "32FC1", 7)
    sweep = sweep_of_depth(image, with_lens(model, values), "/cam/image_raw")
    x, y, z = sweep.points.T.astype(float)
    assert len(z) > 0.5 * 48 * 64
    columns, rows = seen(model, values, x / z, y / z) * 60 + [[31.5], [23.5]]
    assert np.abs(columns - columns.round()).max() < 1e-2
    assert np.abs(rows - rows.round()).max() < 1e-2
    assert len(np.unique(columns.round() + 64 * rows.round())) == len(z)
    assert f"lens distortion {model} taken out" in sweep.note
    rectified = sweep_of_depth(image, with_lens(model, values), "/cam/image_rect_raw")
    assert np.allclose(rectified.points[0, :2], [-31.5 / 30 * 2, -23.5 / 30 * 2])


def test_an_unknown_lens_is_refused_with_the_topic_to_use() -> None:
    image = ROS.image(np.full(SIZE, 2.0, np.float32), "32FC1", 7)
    with pytest.raises(NoScanError, match="'omni' of 1 numbers is not understood: .*image_rect"):
        sweep_of_depth(image, with_lens("omni", [0.1]), "/cam/image_raw")
    still = sweep_of_depth(image, with_lens("omni", [0.0]), "/cam/image_raw")  # K, and no P
    assert np.allclose(still.points[0, :2], [-31.5 / 60 * 2, -23.5 / 60 * 2])


def test_what_is_no_depth_image_is_refused_in_words() -> None:
    good = np.full((4, 6), 1000, np.uint16)

    def refused(message: object, info: object = INFO) -> str:
        with pytest.raises(NoScanError) as caught:
            sweep_of_depth(message, info)
        return str(caught.value)

    assert "bgr8" in refused(ROS.image(good, "bgr8", 7))
    assert "6 x 4 pixels and its CameraInfo 6 x 5" in refused(
        ROS.image(good, "16UC1", 7), ROS.camera_info((5, 6), MATRIX, 7)
    )
    assert "calibrate" in refused(
        ROS.image(good, "16UC1", 7), ROS.camera_info((4, 6), MATRIX * 0, 7)
    )
    assert "shows nothing" in refused(ROS.image(good * 0, "16UC1", 7))
    message = ROS.image(good, "16UC1", 7)
    message.data = message.data[:-1]
    assert "has 47 bytes" in refused(message)
