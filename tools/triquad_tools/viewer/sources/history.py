"""The checkpoints of a store that can be shown, in the order of time."""

import threading
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_files,
    map_folder,
    open_manifest,
)
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources.stored_source import StoredMap

_MAX_OPEN = 4  # maps that stay in memory beyond those that pages show


@dataclass(frozen=True)
class Moment:
    """A checkpoint."""

    epoch: int
    time: str  # UTC as in RFC 3339; empty if the file does not say
    path: Path

    def __str__(self) -> str:
        return f"epoch {self.epoch}, {self.time}" if self.time else f"epoch {self.epoch}"


class DamagedError(ToolError):
    """A checkpoint that cannot be shown."""


class History:
    """The checkpoints of one map in a store, to which a server may add; for several threads."""

    def __init__(self, store: Path) -> None:
        """Read the folder.

        Raises:
            MapFileError: there are no checkpoints, or those of several maps.
            OSError: the folder cannot be read.
        """
        self.folder = map_folder(store)
        self._moments: dict[CheckpointFile, Moment] = {}
        self._damaged: dict[CheckpointFile, str] = {}
        self._reading = threading.Lock()
        self._opening = threading.Lock()  # one at a time: it takes all cores
        self._opened = lru_cache(_MAX_OPEN)(StoredMap)
        self.refresh()

    @property
    def moments(self) -> tuple[Moment, ...]:
        """The checkpoints that can be shown as far as is known, the oldest first."""
        with self._reading:
            files = self._moments.keys() - self._damaged.keys()
            return tuple(self._moments[file] for file in sorted(files))

    @property
    def damaged(self) -> tuple[str, ...]:
        """The errors of those that cannot be shown, the oldest first."""
        with self._reading:
            return tuple(problem for _, problem in sorted(self._damaged.items()))

    def refresh(self) -> None:
        """Update from what a server wrote or deleted meanwhile.

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

    def opened(self, moment: Moment) -> StoredMap:
        """Return the map as it was.

        Raises:
            DamagedError: it cannot be shown; it is a moment no longer.
        """
        try:
            with self._opening:
                return self._opened(moment.path)
        except (FormatError, OSError) as error:
            problem = f"{moment.path.name} is left out: {error}"
            with self._reading:
                for file in [file for file in self._moments if file.path == moment.path]:
                    self._damaged[file] = problem
            raise DamagedError(problem) from error

    def newest(self) -> StoredMap:
        """Return the map as it was at the newest moment that can be shown.

        Raises:
            ToolError: there is none.
        """
        while moments := self.moments:
            with suppress(DamagedError):
                return self.opened(moments[-1])
        raise ToolError(
            f"{self.folder}: no checkpoint can be shown; triquad-pack --recover saves what is "
            "intact"
        )

    def _read(self, file: CheckpointFile) -> None:
        try:
            stamp_ns = open_manifest(file).stamp_ns
        except (FormatError, OSError) as error:
            self._damaged[file] = f"{file.path.name} is left out: {error}"
            return
        stamp = utc_time(stamp_ns) if stamp_ns else ""
        self._moments[file] = Moment(file.epoch, stamp, file.path)
