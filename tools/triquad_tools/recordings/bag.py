"""Bags of ROS 1 and ROS 2 and MCAP files, message by message."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from triquad_tools.console.command import ToolError

_REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex"}
"""What saves a damaged file, by the suffixes that bags have."""


class Message(NamedTuple):
    """A message as it was recorded."""

    connection: Connection
    recorded_ns: int  # nanoseconds since 1970, by the recorder's clock
    payload: bytes


@dataclass(frozen=True)
class OpenBag:
    """A bag that can be read."""

    bag: "Bag"
    reader: AnyReader

    @property
    def connections(self) -> list[Connection]:
        """The recorded connections: several may be of one topic."""
        return self.reader.connections

    def messages(self, connections: Collection[Connection]) -> Iterator[Message]:
        """Yield the messages of some connections in the order in which they were recorded.

        Raises:
            ToolError: the bag is damaged.
        """
        if not connections:
            return
        messages = self.reader.messages(connections)
        while True:
            try:
                message = next(messages, None)
            except Exception as error:  # a damaged file leads the readers anywhere
                raise self.bag.damaged(error) from error
            if message is None:
                return
            yield Message(*message)

    def decode(self, message: Message) -> Any:
        """Return the message as an object with the fields that its type has.

        Raises:
            ToolError: its bytes are no such message.
        """
        kind, topic = message.connection.msgtype, message.connection.topic
        try:
            return self.reader.deserialize(message.payload, kind)
        except Exception as error:  # as above
            text = f"{self.bag.path}: a message on {topic} is no {kind}: {error}"
            raise ToolError(text) from error


@dataclass(frozen=True)
class Bag:
    """The path of a bag, which may be cut into several files."""

    path: Path
    files: tuple[Path, ...]

    @contextmanager
    def open(self) -> Iterator[OpenBag]:
        """Yield the bag, open for reading.

        Raises:
            ToolError: it cannot be read, or is not whole.
        """
        try:
            reader = AnyReader(self.files, default_typestore=get_typestore(Stores.LATEST))
            reader.open()
        except Exception as error:  # a damaged file leads the readers anywhere
            raise self.damaged(error) from error
        try:
            yield OpenBag(self, reader)
        finally:
            reader.close()

    def damaged(self, error: Exception) -> ToolError:
        """Return the error for a bag that cannot be read."""
        files = _bag_files(self.path) if self.path.is_dir() else self.files
        repairs = sorted({_REPAIR[file.suffix] for file in files})
        words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        return ToolError(
            f"{self.path}: the bag cannot be read ({words}); where it was cut off or damaged, "
            f"{' or '.join(map(repr, repairs)) or 'a copy'} saves what is left"
        )


def find_bag(path: Path) -> Bag | None:
    """Return the bag at a path: a file, a folder that ROS 2 wrote, or one of parts of a bag."""
    if path.is_file():
        return Bag(path, (path,)) if path.suffix in _REPAIR else None
    if (path / "metadata.yaml").is_file():
        return Bag(path, (path,))
    files = _bag_files(path)
    return Bag(path, files) if files else None


def _bag_files(folder: Path) -> tuple[Path, ...]:
    files = (file for file in folder.glob("*") if file.suffix in _REPAIR and file.is_file())
    return tuple(sorted(files))
