"""Depth images of ROS."""

import numpy as np
import pytest
from support.ros.ros_messages import IMAGE, RosMessages
from triquad_tools.sensors.ros.depth_camera import sweep_of_depth
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
