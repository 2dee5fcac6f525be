"""Messages of ROS as robots send them, built with the types of a release.

Scripts outside of the project import this module: its place and :class:`RosMessages` stay.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

CLOUD = "sensor_msgs/msg/PointCloud2"
TF = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
PATH = "nav_msgs/msg/Path"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_NUMBERS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class RosMessages:
    """Builds messages of one release, and turns them into its bytes."""

    def __init__(self, release: Stores = Stores.ROS2_JAZZY) -> None:
        self.types = get_typestore(release)
        self._is_ros_1 = release is Stores.ROS1_NOETIC
        if self._is_ros_1:  # it has packages of its own for transforms
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.types.register(get_types_from_msg(definition, TF))

    def encode(self, message: Any, type_name: str) -> bytes:
        if self._is_ros_1:
            return bytes(self.types.serialize_ros1(message, type_name))
        return bytes(self.types.serialize_cdr(message, type_name))

    def header(self, stamp_ns: int, frame: str) -> Any:
        time = self._new("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
        sequence = [0] if self._is_ros_1 else []
        return self._new("std_msgs/msg/Header", *sequence, time, frame)

    def cloud(
        self,
        points: NDArray[Any],
        stamp_ns: int,
        frame: str = "lidar",
        more: Mapping[str, NDArray[Any]] | None = None,
        big_endian: bool = False,
        item: str = "f4",
    ) -> Any:
        """A cloud of points [N, 3], and ``more`` fields of N numbers each, in that order."""
        order = ">" if big_endian else "<"
        columns = {name: points[:, axis].astype(order + item) for axis, name in enumerate("xyz")}
        for name, values in (more or {}).items():
            columns[name] = values.astype(values.dtype.newbyteorder(order))
        dtype = np.dtype([(name, column.dtype) for name, column in columns.items()])
        rows = np.empty(len(points), dtype)
        fields = []
        for name, column in columns.items():
            rows[name] = column
            number = _NUMBERS[column.dtype.str[1:]]
            offset = dtype.fields[name][1]
            fields.append(self._new("sensor_msgs/msg/PointField", name, offset, number, 1))
        step = dtype.itemsize
        return self._new(
            CLOUD,
            self.header(stamp_ns, frame),
            1,
            len(rows),
            fields,
            big_endian,
            step,
            step * len(rows),
            rows.view(np.uint8).reshape(-1),
            False,
        )

    def livox(
        self, points: NDArray[Any], offsets_ns: NDArray[Any], stamp_ns: int, kind: str
    ) -> Any:
        """A scan of a Livox, of the type ``kind`` of one of its drivers."""
        package = kind.partition("/")[0]
        point = (
            "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\n"
        )
        scan = (
            "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\n"
            f"uint8[3] rsvd\n{package}/CustomPoint[] points"
        )
        inner = f"{package}/msg/CustomPoint"
        if kind not in self.types.types:
            types = get_types_from_msg(point + "uint8 line", inner)
            self.types.register({**types, **get_types_from_msg(scan, kind)})
        rows = [
            self._new(inner, int(t), *map(float, point), 0, 0, 0)
            for t, point in zip(offsets_ns, points, strict=True)
        ]
        header, rest = self.header(stamp_ns, "livox"), np.zeros(3, np.uint8)
        return self._new(kind, header, stamp_ns, len(rows), 0, rest, rows)

    def tf(self, stamp_ns: int, *edges: tuple[str, str, NDArray[Any]]) -> Any:
        """Of edges from parent to child with the pose [4, 4] of the child."""
        return self._new(
            TF,
            [
                self._new(
                    "geometry_msgs/msg/TransformStamped",
                    self.header(stamp_ns, parent),
                    child,
                    self._new(
                        "geometry_msgs/msg/Transform",
                        self._vector("Vector3", pose),
                        self._quaternion(pose),
                    ),
                )
                for parent, child, pose in edges
            ],
        )

    def odometry(self, stamp_ns: int, pose: NDArray[Any], parent: str, child: str) -> Any:
        zeros = self._new("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = self._new("geometry_msgs/msg/Twist", zeros, zeros)
        return self._new(
            ODOMETRY,
            self.header(stamp_ns, parent),
            child,
            self._new("geometry_msgs/msg/PoseWithCovariance", self._pose(pose), np.zeros(36)),
            self._new("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36)),
        )

    def pose(self, stamp_ns: int, pose: NDArray[Any], parent: str) -> Any:
        return self._new(POSE, self.header(stamp_ns, parent), self._pose(pose))

    def pose_with_covariance(self, stamp_ns: int, pose: NDArray[Any], parent: str) -> Any:
        inner = self._new("geometry_msgs/msg/PoseWithCovariance", self._pose(pose), np.zeros(36))
        return self._new(POSE_WITH_COVARIANCE, self.header(stamp_ns, parent), inner)

    def path(self, stamps_ns: Sequence[int], poses: NDArray[Any], parent: str) -> Any:
        stamped = [self.pose(*each, "") for each in zip(stamps_ns, poses, strict=True)]
        return self._new(PATH, self.header(stamps_ns[-1], parent), stamped)

    def image(
        self, pixels: NDArray[Any], encoding: str, stamp_ns: int, frame: str = "optical"
    ) -> Any:
        rows, columns = pixels.shape
        return self._new(
            IMAGE,
            self.header(stamp_ns, frame),
            rows,
            columns,
            encoding,
            0,
            columns * pixels.dtype.itemsize,
            np.ascontiguousarray(pixels).view(np.uint8).reshape(-1),
        )

    def compressed_depth(
        self,
        pixels: NDArray[np.uint16],
        stamp_ns: int,
        form: str = "16UC1; compressedDepth png",
        header: bytes = bytes(12),
    ) -> Any:
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "PNG")
        data = np.frombuffer(header + buffer.getvalue(), np.uint8)
        return self._new(COMPRESSED_IMAGE, self.header(stamp_ns, "optical"), form, data)

    def camera_info(
        self, size: tuple[int, int], matrix: NDArray[Any], stamp_ns: int, frame: str = "optical"
    ) -> Any:
        """Of an image of ``size`` rows and columns."""
        region = self._new("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        return self._new(
            CAMERA_INFO,
            self.header(stamp_ns, frame),
            *size,
            "plumb_bob",
            np.zeros(5),
            matrix.reshape(-1).astype(np.float64),
            np.eye(3).reshape(-1),
            np.column_stack([matrix, np.zeros(3)]).reshape(-1).astype(np.float64),
            0,
            0,
            region,
        )

    def _pose(self, pose: NDArray[Any]) -> Any:
        return self._new(
            "geometry_msgs/msg/Pose", self._vector("Point", pose), self._quaternion(pose)
        )

    def _vector(self, name: str, pose: NDArray[Any]) -> Any:
        return self._new(f"geometry_msgs/msg/{name}", *map(float, pose[:3, 3]))

    def _quaternion(self, pose: NDArray[Any]) -> Any:
        values = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return self._new("geometry_msgs/msg/Quaternion", *map(float, values))

    def _new(self, type_name: str, *values: Any) -> Any:
        return self.types.types[type_name](*values)
