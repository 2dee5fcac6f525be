"""Slowly checks all files of a store: corruption is found while the map is in memory."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint_folder import CheckpointFile, checkpoint_files
from triquad_format.mapfile.index import FileBytes, MapIndex, named
from triquad_map.compiled.team import lower_priority

from triquad_server.process.threads import NICENESS

_log = logging.getLogger(__name__)

_HOUR_S = 3600.0
_BYTES_PER_S = 8e6
"""The rate at which a store is read: a disk does a hundred times as much."""


class Scrubber:
    """Reads all checkpoints of a folder again and again, on a thread of its own."""

    def __init__(self, folder: Path, period_h: float, damaged: Callable[[str], None]) -> None:
        """Begin; ``damaged`` is called with the name of each file that is found damaged.

        ``period_h`` goes by between the end of one check and the next, and before the first.
        """
        self._folder = folder
        self._period_s = period_h * _HOUR_S
        self._damaged = damaged
        self._found: set[tuple[str, int]] = set()  # damaged, by name and time of change
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="scrubber")
        self._thread.start()

    def close(self) -> None:
        """End, in the middle of a file if need be."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        lower_priority(2 * NICENESS)
        while not self._stopping.wait(self._period_s):
            started_s = time.monotonic()
            try:
                files = checkpoint_files(self._folder)
            except OSError as error:
                _log.warning("store %s cannot be checked: %s", self._folder, error)
                continue
            for file in files:
                self._check(file)
            if not self._stopping.is_set():
                took_s = time.monotonic() - started_s
                _log.info("checked %d checkpoints on disk in %.0f s", len(files), took_s)

    def _check(self, file: CheckpointFile) -> None:
        """Read a file's own parts; those that lie in other files are checked there."""
        name = file.path.name
        if self._stopping.is_set():
            return
        try:
            version = (name, file.path.stat().st_mtime_ns)
            if version not in self._found:
                self._read(file.path)
        except FileNotFoundError:
            return  # deleted meanwhile, as old checkpoints are
        except OSError as error:
            _log.warning("%s cannot be checked: %s", file.path, error)
        except FormatError as error:
            _log.error("bit rot: %s", error)
            self._found.add(version)
            self._damaged(name)

    def _read(self, path: Path) -> None:
        """Read and check all of a file.

        Raises:
            FormatError: it is damaged.
            OSError: it cannot be read.
        """
        with closing(FileBytes(path)) as file, named(str(path)):
            file.drop_cached()
            index = MapIndex(file)
            for entry in index.manifest.own:
                index.payload(entry)
                if self._stopping.wait(entry.size / _BYTES_PER_S):
                    return
