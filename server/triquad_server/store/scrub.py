"""Slowly checks all files of a store: corruption is found while the map is in memory."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint_folder import PartFiles, checkpoint_files
from triquad_format.mapfile.files import FileBytes, named
from triquad_format.mapfile.index import open_index
from triquad_map.compiled.team import lower_priority

from triquad_server.process.threads import NICENESS

_log = logging.getLogger(__name__)

_HOUR_S = 3600.0
_BYTES_PER_S = 8e6
"""The rate at which a store is read: a disk does a hundred times as much."""


class Scrubber:
    """Reads all checkpoints and parts of a folder again and again, on a thread of its own."""

    def __init__(self, folder: Path, period_h: float, damaged: Callable[[str], None]) -> None:
        """Begin; ``damaged`` is called with the name of each file that is found damaged.

        ``period_h`` goes by between the end of one check and the next, and before the first.
        """
        self._folder = folder
        self._parts = PartFiles(folder)
        self._period_s = period_h * _HOUR_S
        self._damaged = damaged
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
                checkpoints = [file.path for file in checkpoint_files(self._folder)]
                parts = [self._parts.folder / name for name in self._parts.names()]
            except OSError as error:
                _log.warning("store %s cannot be checked: %s", self._folder, error)
                continue
            for path in (*checkpoints, *parts):
                self._check(path)
            if not self._stopping.is_set():
                took_s = time.monotonic() - started_s
                _log.info("checked %d checkpoints on disk in %.0f s", len(checkpoints), took_s)

    def _check(self, path: Path) -> None:
        """Check a file, and wait for as long as its bytes may take."""
        if self._stopping.is_set():
            return
        try:
            with closing(FileBytes(path)) as file, named(str(path)):
                file.drop_cached()
                if path.parent == self._parts.folder:
                    self._parts.check(path.name)
                else:
                    open_index(file).check_unread()
                self._stopping.wait(file.size / _BYTES_PER_S)
        except FileNotFoundError:
            return  # deleted meanwhile, as what is not needed any more is
        except OSError as error:
            _log.warning("%s cannot be checked: %s", path, error)
        except FormatError as error:
            if path.exists():
                _log.error("bit rot: %s", error)
                self._damaged(path.name)
