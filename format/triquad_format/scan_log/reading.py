"""Reads a file of the scan log: docs/reliability.md says where it lies."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TypeAlias

import numpy as np
from mcap.records import Channel, Footer, Message
from mcap.stream_reader import StreamReader

from triquad_format.errors import DamagedMapFileError, FormatError
from triquad_format.mapfile.files import open_regular
from triquad_format.records.arrays import Floats
from triquad_format.scan_log.ros_messages import (
    Transform,
    unpack_cloud,
    unpack_transform,
)
from triquad_format.scan_log.segment import (
    CORRECTIONS,
    NO_RETURN,
    RESETS,
    SCANS,
    TRANSFORMS,
    LoggedCorrection,
    LoggedReset,
    LoggedScan,
)

Entry: TypeAlias = LoggedScan | Transform | LoggedReset | LoggedCorrection
"""What a log has: a scan, the pose of one that was not kept, a reset, or a correction."""


def read_segment(path: Path) -> Iterator[Entry]:
    """Yield what a file of the log has, in the order in which it came.

    Raises:
        DamagedMapFileError: the file is damaged, or is none of the log.
        OSError: it cannot be read.
    """
    with io.BufferedReader(open_regular(path)) as stream:
        try:
            yield from _entries(stream)
        except Exception as error:  # as the library comes upon what it did not expect
            raise DamagedMapFileError(f"{path} is damaged: {error!r}") from error


def _entries(stream: IO[bytes]) -> Iterator[Entry]:
    topics: dict[int, str] = {}
    pose, no_return = None, np.zeros((0, 3), np.float32)  # until the scan comes that they are of
    is_whole = False
    for record in StreamReader(stream, validate_crcs=True).records:
        is_whole |= isinstance(record, Footer)
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        if not isinstance(record, Message):
            continue
        topic, data = topics[record.channel_id], record.data
        if topic.startswith(NO_RETURN):
            no_return = np.frombuffer(data, "<f4").reshape(-1, 3)
        elif topic.startswith(SCANS):
            yield _scan(data, pose, no_return)
            pose, no_return = None, no_return[:0]
        else:
            if pose is not None:
                yield pose
            pose = unpack_transform(data) if topic == TRANSFORMS else None
            if topic == RESETS:
                yield LoggedReset(*np.frombuffer(data, "<f8").reshape(2, 3))
            elif topic.startswith(CORRECTIONS):
                yield LoggedCorrection.unpack(topic.removeprefix(CORRECTIONS), data)
    if pose is not None:
        yield pose
    if not is_whole:
        raise FormatError("it has no end")


def _scan(data: bytes, pose: Transform | None, no_return: Floats) -> LoggedScan:
    """Return a scan of its cloud and the pose before it."""
    stamp_ns, source, points = unpack_cloud(data)
    if pose is None or (pose.stamp_ns, pose.child) != (stamp_ns, source):
        raise FormatError(f"a scan of {source} has no pose before it")
    return LoggedScan(source, stamp_ns, pose.pose, points, no_return)
