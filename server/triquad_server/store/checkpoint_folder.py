"""The files of a map's checkpoints: whether they are as they were, and which are deleted."""

import contextlib
import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import MapFileError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_files,
    newest_of_each,
    open_manifest,
)

from triquad_server.store.retention import KeptCheckpoint, Retention

_log = logging.getLogger(__name__)

_UNFINISHED = ".epoch-*.tmp"  # left by a server that was killed while it wrote


@dataclass(frozen=True)
class _FileIdentity:
    """What tells a file from one that was put in its place, or changed."""

    device: int
    inode: int
    size: int  # bytes
    modified_ns: int  # when its contents changed, nanoseconds since 1970
    changed_ns: int  # when anything about it changed: nobody can set this back


class CheckpointFolder:
    """The folder in which the checkpoints of one map lie."""

    def __init__(self, path: Path, retention: Retention) -> None:
        self.path = path
        self._retention = retention
        self._needed: dict[Path, frozenset[str]] = {}  # names of files, by checkpoint
        self._identities: dict[str, _FileIdentity | None] = {}  # of files that were valid

    def record(self, names: Iterable[str]) -> None:
        """Record files as they are now: they are valid."""
        for name in names:
            self._identities[name] = _file_identity(self.path / name)

    def unchanged(self, names: Iterable[str]) -> bool:
        """Whether files are there, and as they were when they were recorded."""
        for name in names:
            identity = _file_identity(self.path / name)
            if identity is None or identity != self._identities.get(name):
                return False
        return True

    def delete_unfinished(self) -> None:
        """Delete what a server left that was killed while it wrote."""
        _delete(self.path.glob(_UNFINISHED))

    def delete_old(self, newest: int) -> None:
        """Delete the files that no checkpoint needs which is to stay.

        Only those up to the epoch ``newest`` are counted and deleted: what bears a higher number is
        damaged, or not this server's, and must not push out a valid checkpoint.
        """
        try:
            files = [file for file in checkpoint_files(self.path) if file.epoch <= newest]
            sizes = {file.path.name: file.path.stat().st_size for file in files}
            checkpoints = [
                KeptCheckpoint(file.path.stat().st_mtime_ns, self._needed_by(file))
                for file in newest_of_each(files)
            ]
        except OSError as error:
            _log.warning("old checkpoints in %s stay: %s", self.path, error)
            return
        count = self._retention.kept(checkpoints, sizes, time.time_ns())
        needed = frozenset().union(*(checkpoint.files for checkpoint in checkpoints[:count]))
        old = [file.path for file in files if file.path.name not in needed]
        for path in old:
            self._needed.pop(path, None)
            self._identities.pop(path.name, None)
        _delete(old)

    def _needed_by(self, file: CheckpointFile) -> frozenset[str]:
        """Names of the files that a checkpoint consists of."""
        if file.path not in self._needed:
            names = {file.path.name}
            # One that does not open needs nothing any more.
            with contextlib.suppress(MapFileError):
                names |= {other.name for other in open_manifest(file).files}
            self._needed[file.path] = frozenset(names)
        return self._needed[file.path]


def _file_identity(path: Path) -> _FileIdentity | None:
    """The file as it is now; ``None`` where there is none to be seen."""
    try:
        status = path.stat()
    except OSError:
        return None
    return _FileIdentity(
        device=status.st_dev,
        inode=status.st_ino,
        size=status.st_size,
        modified_ns=status.st_mtime_ns,
        changed_ns=status.st_ctime_ns,
    )


def _delete(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s is not needed, but cannot be deleted: %s", path, error)
