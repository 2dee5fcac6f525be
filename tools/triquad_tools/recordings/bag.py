"""Bags of ROS 1 and ROS 2 and MCAP files, message by message."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from triquad_tools.console.command import ToolError

_REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex"}
"""What saves a damaged file, by the suffixes that bags have."""


@dataclass(frozen=True)
class Message:
    """A message as it was recorded."""

    topic: str
    kind: str
    recorded_ns: int  # nanoseconds since 1970, by the recorder's clock
    payload: bytes
    reader: AnyReader

    def decoded(self) -> Any:
        """Return the message as an object with the fields that its type has.

        Raises:
            ToolError: its bytes are no such message.
        """
        try:
            return self.reader.deserialize(self.payload, self.kind)
        except Exception as error:  # damaged bytes lead the decoders anywhere
            text = f"{self.reader.paths[0]}: a message on {self.topic} is no {self.kind}: {error}"
            raise ToolError(text) from error


@dataclass(frozen=True)
class Bag:
    """A bag, which may be cut into several files.

    What reads it raises a ToolError where it cannot be read, or is not whole.
    """

    path: Path
    files: tuple[Path, ...]

    def connections(self) -> list[Connection]:
        """Return the recorded connections: several may be of one topic."""
        try:
            with self._reader() as reader:
                return list(reader.connections)
        except Exception as error:  # a damaged file leads the readers anywhere
            raise self._damaged(error) from error

    def messages(self, *wanted: Callable[[Connection], bool]) -> Iterator[Message]:
        """Yield the messages of the connections that are wanted first, then of others, and so on.

        Each time they come in the order in which they were recorded.
        """
        try:
            with self._reader() as reader:
                for is_wanted in wanted:
                    connections = [each for each in reader.connections if is_wanted(each)]
                    # Of no connections the reader would yield the messages of all.
                    for each, recorded_ns, payload in (
                        reader.messages(connections) if connections else ()
                    ):
                        yield Message(each.topic, each.msgtype, recorded_ns, payload, reader)
        except Exception as error:  # as above
            raise self._damaged(error) from error

    def _reader(self) -> AnyReader:
        return AnyReader(self.files, default_typestore=get_typestore(Stores.LATEST))

    def _damaged(self, error: Exception) -> ToolError:
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
