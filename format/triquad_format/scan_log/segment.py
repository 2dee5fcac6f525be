"""A file of the scan log: the scans that a map took in between two of its checkpoints.

It is an MCAP file of ROS 2 messages: for each scan a transform from ``map`` to a frame with the
name of the source, on ``/tf``, and, of those that are kept, a cloud in that frame, on
``/scans/<source>``, with the stamp of the scan both. Rays that met nothing come between the two, as
directions [M, 3], little-endian float32, on ``/no_return/<source>``; what was reset is on
``/resets``: the least and the greatest corner of a box, six little-endian float64. A correction of
poses before it is on ``/corrections/<source>``, as :class:`LoggedCorrection` packs it.
"""

import io
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TypeAlias

import numpy as np
from mcap.reader import SeekingReader
from mcap.records import Channel, Footer, Message, Statistics
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from triquad_format.errors import DamagedMapFileError, FormatError
from triquad_format.mapfile.files import open_regular
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.scan_log.ros_messages import (
    CLOUD_TYPE,
    DEFINITIONS,
    TRANSFORMS_TYPE,
    Transform,
    pack_cloud,
    pack_transform,
    unpack_cloud,
    unpack_transform,
)

GRAIN_M = 2.0**-8
"""Points are rounded to 4 mm: single precision has that exactly, with zeros that compress."""

_MAP_FRAME = "map"
_TRANSFORMS, _RESETS = "/tf", "/resets"
_SCANS, _NO_RETURN, _CORRECTIONS = "/scans/", "/no_return/", "/corrections/"
"""The topics; the last three before the name of a source."""

_CHUNK_BYTES = 1 << 20

_MOVES = np.dtype([("stamp_ns", "<i8"), ("move", "<f8", (3, 4))])  # of a correction


@dataclass(frozen=True)
class LoggedScan:
    """A scan as a map took it in: thinned, and its points rounded."""

    source: str
    stamp_ns: int  # nanoseconds since 1970
    world_from_sensor: Doubles  # [4, 4] in the coordinates of who published it
    points: Floats  # [N, 3] metres, sensor frame; those beyond its range lie just beyond it
    no_return: Floats  # [M, 3] directions of rays that met nothing, sensor frame


@dataclass(frozen=True)
class LoggedReset:
    """A box that the map forgot, metres, in the coordinates of who asked for it."""

    minimum: Doubles  # [3]
    maximum: Doubles


@dataclass(frozen=True)
class LoggedCorrection:
    """How the scans of a source move that came before, each in its own frame."""

    source: str
    stamps_ns: Longs  # [K] rising, nanoseconds since 1970; scans before the first stay
    moves: Doubles  # [K, 4, 4] at these times; scans after the last move as that
    until_ns: int  # the stamp of the last scan that moves
    since: int = 0  # how often the source's time began again, after the scans that move
    first_epoch: int = 0  # with which the file ends that has the first scan that moves

    def pack(self) -> bytes:
        """Return it without the source."""
        rows = np.zeros(len(self.moves), _MOVES)
        rows["stamp_ns"], rows["move"] = self.stamps_ns, self.moves[:, :3]
        head = np.array([self.until_ns, self.since, self.first_epoch], "<i8")
        return head.tobytes() + rows.tobytes()

    @classmethod
    def unpack(cls, source: str, data: bytes) -> "LoggedCorrection":
        """Return what :meth:`pack` has made.

        Raises:
            ValueError: it is something else.
        """
        until_ns, since, first_epoch = np.frombuffer(data, "<i8", 3).tolist()
        rows = np.frombuffer(data, _MOVES, offset=24)
        moves = np.zeros((len(rows), 4, 4))
        moves[:, :3], moves[:, 3, 3] = rows["move"], 1.0
        return cls(source, rows["stamp_ns"].astype(np.int64), moves, until_ns, since, first_epoch)


Entry: TypeAlias = LoggedScan | Transform | LoggedReset | LoggedCorrection
"""What a log has: a scan, the pose of one that was not kept, a reset, or a correction."""


class SegmentWriter:
    """Writes a file as scans come; it is whole once :meth:`finish` was called.

    Where it cannot be written, any method raises an ``OSError``.
    """

    def __init__(self, path: Path, *, after_loss: bool = False) -> None:
        """Begin a file, in place of what is there.

        ``after_loss``: scans or resets before it could not be written.
        """
        self.path = path
        self.after_loss = after_loss
        self._stream: IO[bytes] = path.open("wb")
        self._mcap = Writer(self._stream, _CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._mcap.start(profile="ros2", library="triquad")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.messages = 0
        self.corrections: list[LoggedCorrection] = []  # that were added

    def add_pose(self, transform: Transform) -> None:
        """Add the pose of a scan, of which no more is kept."""
        stamp_ns, source, pose = transform
        data = pack_transform(stamp_ns, _MAP_FRAME, source, pose)
        self._put(_TRANSFORMS, TRANSFORMS_TYPE, stamp_ns, data)

    def add(self, scan: LoggedScan) -> None:
        """Add a scan."""
        stamp_ns, source = scan.stamp_ns, scan.source
        self.add_pose(Transform(stamp_ns, source, scan.world_from_sensor))
        if len(scan.no_return):
            directions = np.ascontiguousarray(scan.no_return, "<f4").tobytes()
            self._put(_NO_RETURN + source, "", stamp_ns, directions)
        points = (np.round(scan.points / GRAIN_M) * GRAIN_M).astype(np.float32)
        self._put(_SCANS + source, CLOUD_TYPE, stamp_ns, pack_cloud(stamp_ns, source, points))

    def add_reset(self, reset: LoggedReset, stamp_ns: int) -> None:
        """Add that the map forgot a box."""
        corners = np.concatenate([reset.minimum, reset.maximum]).astype("<f8")
        self._put(_RESETS, "", stamp_ns, corners.tobytes())

    def add_correction(self, correction: LoggedCorrection) -> None:
        """Add that the poses of scans before were corrected."""
        data = correction.pack()
        self._put(_CORRECTIONS + correction.source, "", correction.until_ns, data)
        self.corrections.append(correction)

    def finish(self) -> None:
        """End the file."""
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._stream.close()

    def discard(self) -> None:
        """Give the file up, and delete it as far as that is possible."""
        with suppress(OSError):  # what was not written yet finds the disk as full as before
            self._stream.close()
        with suppress(OSError):
            self.path.unlink(missing_ok=True)

    def _put(self, topic: str, kind: str, stamp_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            encoding = "cdr" if kind else "triquad"
            schema = self._schema(kind) if kind else 0
            self._channels[topic] = self._mcap.register_channel(topic, encoding, schema)
        self._mcap.add_message(self._channels[topic], stamp_ns, data, stamp_ns)
        self.messages += 1

    def _schema(self, kind: str) -> int:
        if kind not in self._schemas:
            text = DEFINITIONS[kind].encode()
            self._schemas[kind] = self._mcap.register_schema(kind, "ros2msg", text)
        return self._schemas[kind]


def read_segment(path: Path) -> Iterator[Entry]:
    """Yield what a file of the log has, in the order in which it came.

    Raises:
        DamagedMapFileError: the file is damaged, or is none of the log.
        OSError: it cannot be read.
    """
    with _opened(path) as stream:
        yield from _entries(stream)


def read_corrections(path: Path) -> list[LoggedCorrection]:
    """Return the corrections that a file of the log has, without reading its scans.

    Raises:
        DamagedMapFileError: the file is damaged, or is none of the log.
        OSError: it cannot be read.
    """
    with _opened(path) as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None:
            raise FormatError("it has no end")
        topics = [one.topic for one in summary.channels.values()]
        found = [topic for topic in topics if topic.startswith(_CORRECTIONS)]
        if not found:
            return []
        return [
            LoggedCorrection.unpack(channel.topic.removeprefix(_CORRECTIONS), message.data)
            for _, channel, message in reader.iter_messages(found, log_time_order=False)
        ]


@contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    """Open a file to read it; an error by what is in it says which file is damaged."""
    with io.BufferedReader(open_regular(path)) as stream:
        try:
            yield stream
        except Exception as error:  # as the library comes upon what it did not expect
            raise DamagedMapFileError(f"{path} is damaged: {error!r}") from error


def _entries(stream: IO[bytes]) -> Iterator[Entry]:
    topics: dict[int, str] = {}
    pose, no_return = None, np.zeros((0, 3), np.float32)  # until the scan comes that they are of
    is_whole, read, written = False, 0, -1  # messages: a chunk whose kind is damaged is skipped
    for record in StreamReader(stream, validate_crcs=True).records:
        is_whole |= isinstance(record, Footer)
        if isinstance(record, Statistics):
            written = record.message_count
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        if not isinstance(record, Message):
            continue
        read += 1
        topic, data = topics[record.channel_id], record.data
        if topic.startswith(_NO_RETURN):
            no_return = np.frombuffer(data, "<f4").reshape(-1, 3)
        elif topic.startswith(_SCANS):
            yield _scan(data, pose, no_return)
            pose, no_return = None, no_return[:0]
        else:
            if pose is not None:
                yield pose
            pose = unpack_transform(data) if topic == _TRANSFORMS else None
            if topic == _RESETS:
                yield LoggedReset(*np.frombuffer(data, "<f8").reshape(2, 3))
            elif topic.startswith(_CORRECTIONS):
                yield LoggedCorrection.unpack(topic.removeprefix(_CORRECTIONS), data)
    if pose is not None:
        yield pose
    if not is_whole:
        raise FormatError("it has no end")
    if read != written:
        raise FormatError(f"it has {read} messages, of {written}")


def _scan(data: bytes, pose: Transform | None, no_return: Floats) -> LoggedScan:
    """Return a scan of its cloud and the pose before it."""
    stamp_ns, source, points = unpack_cloud(data)
    if pose is None or (pose.stamp_ns, pose.child) != (stamp_ns, source):
        raise FormatError(f"a scan of {source} has no pose before it")
    return LoggedScan(source, stamp_ns, pose.pose, points, no_return)
