"""The checkpoints of a store that can be shown, in the order of time."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_files,
    map_folder,
    newest_of_each,
    open_manifest,
)
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources.file_source import FileSource
from triquad_tools.viewer.sources.open_maps import OpenMaps


@dataclass(frozen=True)
class Moment:
    """A checkpoint."""

    epoch: int
    time: str  # UTC as in RFC 3339; empty where the file does not tell
    path: Path

    def __str__(self) -> str:
        return f"epoch {self.epoch}, {self.time}" if self.time else f"epoch {self.epoch}"


class DamagedError(ToolError):
    """A checkpoint that cannot be shown."""


class History:
    """The checkpoints of one map in a store, to which a server may add; for several threads."""

    def __init__(self, store: Path, maps: OpenMaps) -> None:
        """Read the folder.

        Raises:
            MapFileError: there are no checkpoints, or those of several maps.
            OSError: the folder cannot be read.
        """
        self.folder = map_folder(store)
        self._maps = maps
        self._moments: dict[CheckpointFile, Moment] = {}
        self._damaged: dict[CheckpointFile, str] = {}
        self._reading = threading.Lock()
        self.refresh()

    @property
    def moments(self) -> tuple[Moment, ...]:
        """What can be shown as far as is known, the oldest first."""
        with self._reading:
            intact = [file for file in self._moments if file not in self._damaged]
            return tuple(
                self._moments[file] for file in sorted(newest_of_each(sorted(intact)[::-1]))
            )

    @property
    def damaged(self) -> tuple[str, ...]:
        """What is wrong with those that cannot be shown, the oldest first."""
        with self._reading:
            return tuple(problem for _, problem in sorted(self._damaged.items()))

    def refresh(self) -> None:
        """Take up what a server wrote or deleted meanwhile.

        Raises:
            ToolError: the folder cannot be read.
        """
        try:
            found = checkpoint_files(self.folder)
        except OSError as error:
            raise ToolError(f"{self.folder} cannot be read: {error.strerror}") from error
        with self._reading:
            for file in found:
                if file not in self._moments and file not in self._damaged:
                    self._read(file)
            for known in (self._moments, self._damaged):
                for file in known.keys() - set(found):
                    known.pop(file)

    def use(self, moment: Moment) -> FileSource:
        """The map as it was, until :meth:`release`.

        Raises:
            DamagedError: it cannot be shown; it is a moment no longer.
        """
        try:
            return self._maps.use(moment.path)
        except (FormatError, OSError) as error:
            problem = f"{moment.path.name} is left out: {error}"
            with self._reading:
                for file in [file for file in self._moments if file.path == moment.path]:
                    self._damaged[file] = problem
            raise DamagedError(problem) from error

    def release(self, moment: Moment) -> None:
        """It is shown no longer."""
        self._maps.release(moment.path)

    @contextmanager
    def using(self, moment: Moment) -> Iterator[FileSource]:
        """The map as it was; errors as of :meth:`use`."""
        source = self.use(moment)
        try:
            yield source
        finally:
            self.release(moment)

    def _read(self, file: CheckpointFile) -> None:
        try:
            stamp_ns = open_manifest(file).stamp_ns
        except (FormatError, OSError) as error:
            self._damaged[file] = f"{file.path.name} is left out: {error}"
            return
        time = utc_time(stamp_ns) if stamp_ns else ""
        self._moments[file] = Moment(file.epoch, time, file.path)
