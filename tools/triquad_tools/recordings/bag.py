"""Bags of ROS 1 and ROS 2 and MCAP files, message by message."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from triquad_tools.console.command import ToolError
from triquad_tools.sensors.ros.from_bytes import decode
from triquad_tools.sensors.sweep import NoScanError

MCAP = (".mcap", ".mcap.zstd")
_REPAIR = {
    ".bag": "rosbag reindex",
    ".bag.active": "rosbag reindex",
    ".mcap": "mcap recover",
    ".mcap.zstd": "zstd -d",
    ".db3": "ros2 bag reindex",
    ".db3.zstd": "zstd -d",
}
"""What saves a damaged file, by the endings that bags have."""


@dataclass(frozen=True)
class Channel:
    """Where messages of one type were recorded from; several may be of one topic."""

    topic: str
    kind: str  # of the messages
    count: int
    file: Path
    decode: Callable[[bytes], Any]  # while the bag is read
    is_ros_1: bool = False
    foreign: str = ""  # the encoding of messages that are not of ROS


Wanted = Callable[[Channel], bool]  # tells of a channel whether its messages are wanted


class Message(NamedTuple):
    """A message as it was recorded."""

    channel: Channel
    recorded_ns: int  # nanoseconds since 1970, by the recorder's clock
    payload: bytes

    def decoded(self) -> Any:
        """Return the message as an object with the fields that its type has.

        Raises:
            NoScanError: its bytes are no such message.
        """
        channel = self.channel
        try:
            return decode(self.payload, channel.kind, channel.decode, is_ros_1=channel.is_ros_1)
        except Exception as error:  # damaged bytes lead the decoders anywhere
            raise NoScanError("decode", f"no {channel.kind}: {error!r}") from error


@dataclass(frozen=True)
class Bag:
    """A bag, which may be cut into several files."""

    path: Path
    files: tuple[Path, ...]
    remarks: list[str] = field(default_factory=list)  # on what is missing, once it was read

    def channels(self) -> list[Channel]:
        """Return the recorded channels."""
        try:
            with self._reader() as reader:
                return [_channel(reader, each) for each in reader.connections]
        except Exception as error:  # a damaged file leads the readers anywhere
            raise self.damaged(error) from error

    def messages(self, is_wanted: Wanted) -> Iterator[Message]:
        """Yield the messages of channels that are wanted in the order of their recording."""
        try:
            with self._reader() as reader:
                channels = {id(each): _channel(reader, each) for each in reader.connections}
                chosen = [x for x in reader.connections if is_wanted(channels[id(x)])]
                # Of no connections the reader would yield the messages of all.
                for each, recorded_ns, payload in reader.messages(chosen) if chosen else ():
                    yield Message(channels[id(each)], recorded_ns, payload)
        except Exception as error:  # as above
            raise self.damaged(error) from error

    def damaged(self, error: Exception) -> ToolError:
        """Return the error for a bag of which nothing can be read."""
        files = _bag_files(self.path) if self.path.is_dir() else self.files
        repairs = sorted({_REPAIR[_ending(file)] for file in files})
        words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        return ToolError(
            f"{self.path}: the bag cannot be read ({words}); where it was cut off, damaged, or has "
            f"no index, {' or '.join(map(repr, repairs)) or 'a copy'} saves what is left"
        )

    def _reader(self) -> AnyReader:
        return AnyReader(self.files, default_typestore=get_typestore(Stores.LATEST))


def _channel(reader: AnyReader, known: Connection) -> Channel:
    types = reader.typestore
    read = types.deserialize_cdr if reader.is2 else types.deserialize_ros1
    decode = partial(read, typename=known.msgtype)
    file = Path(str(getattr(known.owner, "path", reader.paths[0])))
    return Channel(known.topic, known.msgtype, known.msgcount, file, decode, not reader.is2)


def bag_files(path: Path) -> tuple[Path, ...]:
    """Return the files at a path of which each is a bag or a part of one, or a folder of ROS 2."""
    if path.is_file():
        return (path,) if _ending(path) else ()
    files = _bag_files(path)
    is_whole = (path / "metadata.yaml").is_file() and any(_ending(f) not in MCAP for f in files)
    return (path,) if is_whole else files


def _bag_files(folder: Path) -> tuple[Path, ...]:
    return tuple(sorted(file for file in folder.glob("*") if file.is_file() and _ending(file)))


def _ending(file: Path) -> str:
    """Return the ending that bags have; nothing if a file is none."""
    return max((each for each in _REPAIR if file.name.endswith(each)), key=len, default="")
