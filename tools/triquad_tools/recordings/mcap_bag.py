"""MCAP files of any writer, read from front to back: without index, and where they are cut off."""

import heapq
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import zstandard
from mcap import records
from mcap.reader import SeekingReader
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from triquad_tools.recordings.bag import MCAP, Bag, Channel, Message, Wanted, bag_files

_ZSTD = b"\x28\xb5\x2f\xfd"  # what rosbag2 compresses message by message begins so


def find_bag(path: Path) -> Bag | None:
    """Return the bag at a path: a file, a folder that ROS 2 wrote, or one of parts of a bag."""
    files = bag_files(path)
    is_mcap = all(file.name.endswith(MCAP) for file in files)
    return (McapBag if is_mcap else Bag)(path, files) if files else None


class McapBag(Bag):
    """MCAP files: what is not of ROS is named with its encoding."""

    def channels(self) -> list[Channel]:
        """Return the recorded channels, of a file without an index after all of it was read."""
        return [each for file in self.files for each in self._channels(file)]

    def messages(self, is_wanted: Wanted) -> Iterator[Message]:
        """Yield messages, as of other bags."""
        files = [self._messages(file, is_wanted) for file in self.files]
        return heapq.merge(*files, key=lambda one: one[1]) if len(files) > 1 else files[0]

    def _channels(self, file: Path) -> list[Channel]:
        summary, contents = _summary(file), _Contents(file)
        if summary is not None:
            counts = Counter(summary.statistics.channel_message_counts)
            for record in (*summary.schemas.values(), *summary.channels.values()):
                contents.learn(record)
        else:
            counts = Counter(message.channel_id for message in self._found(contents))
        return [replace(x, count=counts[number]) for number, x in contents.channels.items()]

    def _messages(self, file: Path, is_wanted: Wanted) -> Iterator[Message]:
        contents, wanted = _Contents(file), dict[int, bool]()
        for message in self._found(contents):
            number, payload = message.channel_id, message.data
            channel = contents.channels.get(number)
            if number not in wanted:
                wanted[number] = channel is not None and is_wanted(channel)
            if channel is not None and wanted[number]:
                if payload.startswith(_ZSTD):
                    payload = zstandard.decompress(payload)
                yield Message(channel, message.log_time, payload)

    def _found(self, contents: "_Contents") -> Iterator[records.Message]:
        """Yield all messages; the channels are added to ``contents`` as they come."""
        file, broken, count = contents.file, 0, 0  # chunks, and messages
        with zstandard.open(file, "rb") if file.suffix == ".zstd" else file.open("rb") as stream:
            reading = StreamReader(stream, emit_chunks=True).records
            while True:
                try:
                    record = next(reading, None)
                except Exception as error:  # where it is cut off, anything may come
                    if not contents.channels:
                        raise self.damaged(error) from error
                    self._tell(file, f"cut off or damaged after {count} messages")
                    return
                if record is None:
                    break
                inside = [record]
                try:
                    if isinstance(record, records.Chunk):
                        inside = breakup_chunk(record, validate_crc=True)
                except Exception:  # as above
                    broken += 1
                    continue
                for each in inside:
                    if isinstance(each, records.Message):
                        count += 1
                        yield each
                    else:
                        contents.learn(each)
        if broken:
            self._tell(file, f"{broken} of its chunks are damaged")

    def _tell(self, file: Path, what: str) -> None:
        size = f"of {file.stat().st_size / 1e6:.3g} MB"
        line = f"{file.name} ({size}) is not whole: {what}; what is whole of it is read"
        if line not in self.remarks:
            self.remarks.append(line)


class _Contents:
    def __init__(self, file: Path) -> None:
        self.file = file
        self.channels: dict[int, Channel] = {}
        self._schemas: dict[int, records.Schema] = {}

    def learn(self, record: object) -> None:
        """Remember a schema or a channel."""
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, records.Channel) and record.id not in self.channels:
            schema = self._schemas.get(record.schema_id)
            self.channels[record.id] = _channel(self.file, record, schema)


def _channel(file: Path, channel: records.Channel, schema: records.Schema | None) -> Channel:
    encoding = channel.message_encoding
    name = schema.name.replace("::", "/") if schema is not None else ""
    if encoding not in ("cdr", "ros1") or not name:
        what = encoding or "unknown"
        return Channel(channel.topic, name or what, 0, file, bytes, foreign=what)
    kind, is_ros_1 = normalize_msgtype(name), encoding == "ros1"
    text = schema.data.decode(errors="replace") if schema is not None else ""

    def decode(payload: bytes) -> Any:
        types = _types(kind, text, is_ros_1)
        read = types.deserialize_ros1 if is_ros_1 else types.deserialize_cdr
        return read(payload, kind)

    return Channel(channel.topic, kind, 0, file, decode, is_ros_1)


@cache
def _types(kind: str, text: str, is_ros_1: bool) -> Typestore:
    """Return the types that a schema defines, or, where it is not understood, those of ROS."""
    try:
        types = get_typestore(Stores.EMPTY)
        types.register(get_types_from_msg(text, kind))
        types.get_msgdef(kind)
    except Exception:  # a text of whatever writer, or of IDL
        return get_typestore(Stores.ROS1_NOETIC if is_ros_1 else Stores.LATEST)
    return types


def _summary(file: Path) -> Any:
    """Return the index of a file; None where it has none, or not all of it."""
    try:
        with file.open("rb") as stream:
            summary = SeekingReader(stream).get_summary()
    except Exception:  # as of any damaged file
        return None
    if summary is None or summary.statistics is None:
        return None
    is_whole = summary.statistics.channel_message_counts.keys() <= summary.channels.keys()
    return summary if is_whole and summary.channels else None
