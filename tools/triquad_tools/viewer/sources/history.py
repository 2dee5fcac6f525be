"""The checkpoints of a store that can be shown, in the order of time."""

import threading
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_files,
    map_folder,
)
from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.reader import open_manifest

from triquad_tools.console.command import ToolError
from triquad_tools.viewer.sources.stored_map import StoredMap

_MAX_OPEN = 4  # maps that stay in memory beyond those that pages show


class DamagedError(ToolError):
    """A checkpoint that cannot be shown."""


class History:
    """The checkpoints of one map in a store, to which a server may add; for several threads."""

    def __init__(self, store: Path) -> None:
        """Find the folder.

        Raises:
            MapFileError: there are no checkpoints, or those of several maps.
            OSError: the folder cannot be read.
        """
        self.folder = map_folder(store)
        self._damaged: dict[CheckpointFile, str] = {}  # as far as is known, and why
        self._opening = threading.Lock()  # one at a time: it takes all cores
        self._open = lru_cache(_MAX_OPEN)(lambda path: StoredMap(path, str(self.folder)))

    def files(self) -> list[CheckpointFile]:
        """Return the checkpoints that can be shown as far as is known, the oldest first.

        Raises:
            ToolError: the folder cannot be read.
        """
        try:
            found = checkpoint_files(self.folder)
        except OSError as error:
            raise ToolError(f"{self.folder} cannot be read: {error.strerror}") from error
        return [file for file in reversed(found) if file not in self._damaged]

    def damaged(self) -> list[str]:
        """Return the errors of those that cannot be shown and are still there."""
        return [why for file, why in sorted(self._damaged.items()) if file.path.exists()]

    def opened(self, file: CheckpointFile) -> StoredMap:
        """Return the map as it was.

        Raises:
            DamagedError: it cannot be shown; it is among the files no longer.
        """
        try:
            with self._opening:
                return self._open(file.path)
        except (FormatError, OSError) as error:
            self._damaged[file] = f"{file.path.name} is left out: {error}"
            raise DamagedError(self._damaged[file]) from error

    def newest(self) -> StoredMap:
        """Return the map as it was at the newest moment that can be shown.

        Raises:
            ToolError: there is none.
        """
        while files := self.files():
            with suppress(DamagedError):
                return self.opened(files[-1])
        raise ToolError(
            f"{self.folder}: no checkpoint can be shown; triquad-pack --recover saves what is "
            "intact"
        )


@lru_cache
def moment(file: CheckpointFile) -> str:
    """Return the epoch of a checkpoint, and its time, UTC as in RFC 3339, if the file says it."""
    with suppress(FormatError, OSError):
        if stamp_ns := open_manifest(file).stamp_ns:
            return f"epoch {file.epoch}, {utc_time(stamp_ns)}"
    return f"epoch {file.epoch}"
