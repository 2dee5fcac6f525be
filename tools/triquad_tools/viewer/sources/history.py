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
from triquad_tools.viewer.sources.stored_map import StoredMap

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
        # What is known of each file: its moment, or why it cannot be shown.
        self._known: dict[CheckpointFile, Moment | str] = {}
        self._opening = threading.Lock()  # one at a time: it takes all cores
        self._open = lru_cache(_MAX_OPEN)(lambda path: StoredMap(path, str(self.folder)))
        self.refresh()

    @property
    def moments(self) -> tuple[Moment, ...]:
        """The checkpoints that can be shown as far as is known, the oldest first."""
        return tuple(what for _, what in sorted(self._known.items()) if isinstance(what, Moment))

    @property
    def damaged(self) -> tuple[str, ...]:
        """The errors of those that cannot be shown, the oldest first."""
        return tuple(what for _, what in sorted(self._known.items()) if isinstance(what, str))

    def refresh(self) -> None:
        """Update from what a server wrote or deleted meanwhile.

        Raises:
            ToolError: the folder cannot be read.
        """
        known = self._known  # which others may replace, but nobody changes
        try:
            found = checkpoint_files(self.folder)
        except OSError as error:
            raise ToolError(f"{self.folder} cannot be read: {error.strerror}") from error
        self._known = {file: known.get(file) or _read(file) for file in found}

    def opened(self, moment: Moment) -> StoredMap:
        """Return the map as it was.

        Raises:
            DamagedError: it cannot be shown; it is a moment no longer.
        """
        try:
            with self._opening:
                return self._open(moment.path)
        except (FormatError, OSError) as error:
            problem = f"{moment.path.name} is left out: {error}"
            known = self._known.items()
            self._known = {f: problem if f.path == moment.path else what for f, what in known}
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


def _read(file: CheckpointFile) -> Moment | str:
    """Return the moment of a file, or why it cannot be shown."""
    try:
        stamp_ns = open_manifest(file).stamp_ns
    except (FormatError, OSError) as error:
        return f"{file.path.name} is left out: {error}"
    return Moment(file.epoch, utc_time(stamp_ns) if stamp_ns else "", file.path)
