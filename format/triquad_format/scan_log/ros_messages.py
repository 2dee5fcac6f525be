"""A cloud and a transform as ROS 2 writes them to MCAP: plain CDR, little-endian.

Plain CDR is that of OMG DDS-XTypes 1.3, 7.4.1: each number lies at a multiple of its size, counted
from behind the four bytes that name the encoding.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from triquad_format.errors import FormatError
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.records.pose import pose_matrices, quaternion_of

CLOUD_TYPE, TRANSFORMS_TYPE = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"

_LINE = "\n" + 80 * "=" + "\nMSG: "
_HEADER = (
    f"{_LINE}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
    f"{_LINE}builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
)
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
    f"{_LINE}geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z"
    f"{_LINE}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w",
}
"""The definitions of the types, for the schemas of a file."""

_ENCODING = b"\x00\x01\x00\x00"  # plain CDR, little-endian
_FLOAT32 = 7  # of PointField
_POINT_BYTES = 12
_SECOND_NS = 1_000_000_000


class _Packer:
    """Appends values to a message."""

    def __init__(self) -> None:
        self.data = bytearray(_ENCODING)

    def put(self, code: str, *values: Any) -> None:
        """Append numbers of one kind, a code of ``struct``."""
        size = struct.calcsize(code)
        self.data += bytes(-(len(self.data) - len(_ENCODING)) % size)
        self.data += struct.pack(f"<{len(values)}{code}", *values)

    def put_text(self, text: str) -> None:
        """Append a string."""
        encoded = text.encode() + b"\0"
        self.put("I", len(encoded))
        self.data += encoded

    def put_header(self, stamp_ns: int, frame: str) -> None:
        """Append a header."""
        self.put("i", stamp_ns // _SECOND_NS)
        self.put("I", stamp_ns % _SECOND_NS)
        self.put_text(frame)


class _Unpacker:
    """Takes values off a message; raises struct.error where it is too short."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = len(_ENCODING)

    def take(self, code: str, count: int = 1) -> tuple[Any, ...]:
        """Take numbers of one kind."""
        size = struct.calcsize(code)
        self._at += -(self._at - len(_ENCODING)) % size
        values = struct.unpack_from(f"<{count}{code}", self._data, self._at)
        self._at += count * size
        return values

    def take_text(self) -> str:
        """Take a string."""
        return self.take_bytes()[:-1].decode()

    def take_bytes(self) -> bytes:
        """Take a sequence of bytes."""
        (count,) = self.take("I")
        (found,) = struct.unpack_from(f"{count}s", self._data, self._at)
        self._at += count
        return bytes(found)

    def take_header(self) -> tuple[int, str]:
        """Take a header; return its stamp, nanoseconds since 1970, and its frame."""
        (seconds,), (nanoseconds,) = self.take("i"), self.take("I")
        return seconds * _SECOND_NS + nanoseconds, self.take_text()


def pack_cloud(stamp_ns: int, frame: str, points: Floats) -> bytes:
    """Return a cloud of ``points`` [N, 3], metres, in the frame of that name."""
    packer = _Packer()
    packer.put_header(stamp_ns, frame)
    packer.put("I", 1, len(points), 3)  # height, width, fields
    for axis, name in enumerate("xyz"):
        packer.put_text(name)
        packer.put("I", 4 * axis)
        packer.put("B", _FLOAT32)
        packer.put("I", 1)
    packer.put("?", False)
    packer.put("I", _POINT_BYTES, _POINT_BYTES * len(points), _POINT_BYTES * len(points))
    packer.data += np.ascontiguousarray(points, "<f4").tobytes()
    packer.put("?", True)
    return bytes(packer.data)


def unpack_cloud(data: bytes) -> tuple[int, str, Floats]:
    """Return stamp, frame and points [N, 3] of what :func:`pack_cloud` made.

    Raises:
        FormatError: it is something else.
    """
    with _refusing("cloud", data):
        unpacker = _Unpacker(data)
        stamp_ns, frame = unpacker.take_header()
        _, count, fields = unpacker.take("I", 3)
        for _ in range(fields):
            unpacker.take_text()
            unpacker.take("I")
            unpacker.take("B")
            unpacker.take("I")
        unpacker.take("?")
        unpacker.take("I", 2)
        return stamp_ns, frame, np.frombuffer(unpacker.take_bytes(), "<f4").reshape(count, 3)


def pack_transform(stamp_ns: int, parent: str, child: str, pose: Doubles) -> bytes:
    """Return the ``pose`` [4, 4] of frame ``child`` in frame ``parent``."""
    packer = _Packer()
    packer.put("I", 1)
    packer.put_header(stamp_ns, parent)
    packer.put_text(child)
    packer.put("d", *pose[:3, 3].tolist(), *quaternion_of(pose[:3, :3]).tolist())
    return bytes(packer.data)


def unpack_transform(data: bytes) -> tuple[int, str, Doubles]:
    """Return stamp, child and pose [4, 4] of what :func:`pack_transform` made.

    Raises:
        FormatError: it is something else.
    """
    with _refusing("transform", data):
        unpacker = _Unpacker(data)
        unpacker.take("I")
        stamp_ns, _ = unpacker.take_header()
        child, numbers = unpacker.take_text(), np.array(unpacker.take("d", 7))
        return stamp_ns, child, pose_matrices(numbers[:3], numbers[3:])


@contextmanager
def _refusing(what: str, data: bytes) -> Iterator[None]:
    """Refuse a message that cannot be unpacked.

    Raises:
        FormatError: it is damaged.
    """
    try:
        yield
    except (struct.error, UnicodeDecodeError, ValueError) as error:
        raise FormatError(f"a {what} of {len(data)} bytes is damaged: {error}") from error
