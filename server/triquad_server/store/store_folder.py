"""The folder of one map: its checkpoints, and the parts that these name."""

import logging
from collections.abc import Iterable
from pathlib import Path

from triquad_format.errors import FormatError, TooLargeMapFileError, UnsupportedMapFileError
from triquad_format.mapfile.checkpoint import read_checkpoint
from triquad_format.mapfile.checkpoint_folder import checkpoint_files, checkpoint_name, set_aside
from triquad_format.mapfile.durable_file import sync_folder
from triquad_format.mapfile.part_files import PartFiles

from triquad_server.settings import StoreSettings
from triquad_server.store.retention import StoredCheckpoint, files_of, staying

_log = logging.getLogger(__name__)

_UNFINISHED = ".*.tmp"
"""The files left by a server that was killed, or whose disk was full, while it wrote."""


class StoreFolder:
    """Deletes checkpoints that need not stay, then the parts that no checkpoint names any more."""

    def __init__(self, path: Path, retention: StoreSettings) -> None:
        """Take the folder of one map."""
        self.path = path
        self.parts = PartFiles(path)
        self._retention = retention
        self._read: dict[Path, tuple[tuple[int, ...], StoredCheckpoint]] = {}  # as of a status

    def retain(self, newest: int) -> None:
        """Delete the checkpoints that need not stay, and what they alone need.

        Only those up to the epoch ``newest`` are counted and deleted: a file with a higher number
        is damaged, or not this server's, and must not push out a valid checkpoint.
        """
        try:
            found = [file for file in checkpoint_files(self.path) if file.epoch <= newest]
            stay = staying([self._stored(file.path) for file in found], self._retention)
            names = files_of(stay)
            _delete(file.path for file in found if file.path.name not in names)
            # Else a power cut could leave a checkpoint whose parts are deleted.
            sync_folder(self.path)
        except (FormatError, OSError) as error:
            _log.warning("old checkpoints in %s stay: %s", self.path, error)
            return
        self.sweep()

    def sweep(self) -> None:
        """Delete unfinished files, and the parts that no checkpoint names.

        A checkpoint that was set aside as damaged names its parts, too: the others can be saved.
        """
        _delete([*self.path.glob(_UNFINISHED), *self.parts.folder.glob(_UNFINISHED)])
        try:
            paths = [file.path for file in checkpoint_files(self.path)] + set_aside(self.path)
            self._read = {path: read for path, read in self._read.items() if path in paths}
            needed = files_of(self._stored(path) for path in paths)
            names = self.parts.names()
        except (FormatError, OSError) as error:
            _log.warning("parts in %s stay, needed or not: %s", self.path, error)
            return
        _delete(self.parts.folder / name for name in names - needed.keys())

    def _stored(self, path: Path) -> StoredCheckpoint:
        """Return what is needed of a checkpoint's file, which is read once.

        Raises:
            FormatError: it may be valid, but cannot be read by this release, or now.
            OSError: it cannot be read.
        """
        status = path.stat()
        # Two files that follow each other at once have the same time of change.
        version = (status.st_mtime_ns, status.st_ino, status.st_size)
        if path not in self._read or self._read[path][0] != version:
            self._read[path] = (version, _read(path, status.st_size))
        return self._read[path][1]


def _read(path: Path, size: int) -> StoredCheckpoint:
    """Return what is needed of the file of a checkpoint; one that is damaged names no parts."""
    try:
        checkpoint = read_checkpoint(path)
    except (UnsupportedMapFileError, TooLargeMapFileError):
        raise
    except FormatError:
        return StoredCheckpoint({path.name: size})
    if checkpoint is None:
        return StoredCheckpoint({path.name: size})
    parts = {entry.name: entry.stored for entry in checkpoint.manifest.entries}
    restored = checkpoint.restored
    restored_as = "" if restored is None else checkpoint_name(restored.as_epoch)
    return StoredCheckpoint({path.name: size, **parts}, checkpoint.undoes, restored_as)


def _delete(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s is not needed, but cannot be deleted: %s", path, error)
