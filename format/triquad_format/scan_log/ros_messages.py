"""A cloud and a transform as ROS 2 writes them to MCAP, with the types' definitions.

Messages are CDR, little-endian, which libraries write and read as well, but with objects: large
messages take seconds.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.pose import pose_matrices, quaternion_of

CLOUD_TYPE, TRANSFORMS_TYPE = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"

_LINE = "\n" + 80 * "=" + "\nMSG: "
_HEADER = (
    f"{_LINE}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
    f"{_LINE}builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
)
_QUATERNION = f"{_LINE}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w"
DEFINITIONS = {
    CLOUD_TYPE: "std_msgs/Header header\nuint32 height\nuint32 width\n"
    "sensor_msgs/PointField[] fields\nbool is_bigendian\nuint32 point_step\nuint32 row_step\n"
    f"uint8[] data\nbool is_dense{_HEADER}"
    f"{_LINE}sensor_msgs/PointField\nstring name\nuint32 offset\nuint8 datatype\nuint32 count",
    TRANSFORMS_TYPE: "geometry_msgs/TransformStamped[] transforms"
    f"{_LINE}geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\n"
    f"geometry_msgs/Transform transform{_HEADER}"
    f"{_LINE}geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation"
    f"{_LINE}geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z{_QUATERNION}",
}
"""The definitions of the types, for the schemas of a file."""

_FLOAT32 = 7  # of PointField
_POINT_BYTES = 12
_SECOND_NS = 1_000_000_000
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # plain CDR


class CdrWriter:
    """Fields in the order of the message's definition (OMG formal/02-06-51, chapter 15)."""

    def __init__(self) -> None:
        self._data = bytearray()

    def numbers(self, dtype: str, *values: float) -> "CdrWriter":
        """Write numbers of one type, such as ``<f8``."""
        return self._array(np.array(values, dtype))

    def text(self, value: str) -> "CdrWriter":
        """Write a string."""
        data = value.encode() + b"\x00"
        self.numbers("<u4", len(data))
        self._data += data
        return self

    def sequence(self, values: NDArray[np.generic]) -> "CdrWriter":
        """Write elements [N, ...] of one or more numbers each."""
        self.numbers("<u4", len(values))
        return self._array(values) if len(values) else self

    def payload(self) -> bytes:
        """Return the bytes of the message."""
        return _LITTLE_ENDIAN + bytes(self._data)

    def _array(self, values: NDArray[np.generic]) -> "CdrWriter":
        self._data += bytes(-len(self._data) % values.itemsize)
        self._data += values.tobytes()
        return self


class CdrReader:
    """The fields of a message, in the order of its definition."""

    def __init__(self, payload: bytes) -> None:
        """Begin with the first field.

        Raises:
            ValueError: it is no plain little-endian CDR.
        """
        if payload[:4] != _LITTLE_ENDIAN:
            raise ValueError(f"no plain little-endian CDR: {payload[:4].hex()}")
        self._data = memoryview(payload)[4:]
        self._at = 0

    def numbers(self, dtype: str, count: int = 1) -> NDArray[Any]:
        """Read numbers [count] of one type, such as ``<f8``.

        Raises:
            ValueError: the message ends before.
        """
        self._at += -self._at % np.dtype(dtype).itemsize
        values = np.frombuffer(self._data, dtype, count, self._at)
        self._at += values.nbytes
        return values

    def text(self) -> str:
        """Read a string.

        Raises:
            ValueError: the message ends before, or it is no text.
        """
        return self.numbers("u1", int(self.numbers("<u4")[0])).tobytes()[:-1].decode()


def pack_cloud(stamp_ns: int, frame: str, points: Floats) -> bytes:
    """Return a cloud of ``points`` [N, 3], metres, in the frame of that name."""
    writer = _with_header(CdrWriter(), stamp_ns, frame)
    writer.numbers("<u4", 1, len(points), 3)  # height, width, fields
    for axis, name in enumerate("xyz"):
        writer.text(name).numbers("<u4", 4 * axis).numbers("u1", _FLOAT32).numbers("<u4", 1)
    writer.numbers("?", False).numbers("<u4", _POINT_BYTES, _POINT_BYTES * len(points))
    data = np.ascontiguousarray(points, "<f4").view(np.uint8).ravel()
    return writer.sequence(data).numbers("?", True).payload()


def pack_transform(stamp_ns: int, parent: str, child: str, pose: Doubles) -> bytes:
    """Return the ``pose`` [4, 4] of frame ``child`` in frame ``parent``."""
    writer = _with_header(CdrWriter().numbers("<u4", 1), stamp_ns, parent).text(child)
    return _with_pose(writer, pose).payload()


class Transform(NamedTuple):
    """The pose of a frame in another."""

    stamp_ns: int
    child: str
    pose: Doubles  # [4, 4]


def unpack_cloud(data: bytes) -> tuple[int, str, Floats]:
    """Return stamp, frame and points [N, 3] of what :func:`pack_cloud` has made.

    Raises:
        ValueError: it is something else.
    """
    reader = CdrReader(data)
    stamp_ns, frame = _read_header(reader)
    _, count, fields = reader.numbers("<u4", 3).tolist()
    for _ in range(fields):
        reader.text()
        reader.numbers("<u4"), reader.numbers("u1"), reader.numbers("<u4")
    reader.numbers("?"), reader.numbers("<u4", 2)
    size = int(reader.numbers("<u4")[0])
    points = reader.numbers("u1", size).view("<f4").reshape(count, 3)
    return stamp_ns, frame, points


def unpack_transform(data: bytes) -> Transform:
    """Return what :func:`pack_transform` was given.

    Raises:
        ValueError: it is something else.
    """
    reader = CdrReader(data)
    reader.numbers("<u4")
    stamp_ns, _ = _read_header(reader)
    child = reader.text()
    return Transform(stamp_ns, child, _read_pose(reader))


def _with_pose(writer: CdrWriter, pose: Doubles) -> CdrWriter:
    return writer.numbers("<f8", *pose[:3, 3].tolist(), *quaternion_of(pose[:3, :3]).tolist())


def _read_pose(reader: CdrReader) -> Doubles:
    numbers = reader.numbers("<f8", 7)
    return pose_matrices(numbers[:3], numbers[3:])


def _read_header(reader: CdrReader) -> tuple[int, str]:
    seconds, nanoseconds = int(reader.numbers("<i4")[0]), int(reader.numbers("<u4")[0])
    return seconds * _SECOND_NS + nanoseconds, reader.text()


def _with_header(writer: CdrWriter, stamp_ns: int, frame: str) -> CdrWriter:
    seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
    return writer.numbers("<i4", seconds).numbers("<u4", nanoseconds).text(frame)
