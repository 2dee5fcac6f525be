"""The checkpoints of a map in their folder, checked for changes and locked for writing."""

import contextlib
import fcntl
import logging
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from triquad_format.errors import MapFileError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_files,
    newest_of_each,
    open_manifest,
)
from triquad_format.mapfile.protections import PROTECTIONS_NAME, Restored

from triquad_server.errors import StoreError
from triquad_server.settings import StoreSettings
from triquad_server.store.protected_checkpoints import ProtectedCheckpoints
from triquad_server.store.retention import KeptCheckpoint, bytes_of, needed_files

_log = logging.getLogger(__name__)

_LOCK = "lock"
_UNFINISHED = (".epoch-*.tmp", f".{PROTECTIONS_NAME}.*.tmp")
"""The files left by a server that was killed while it wrote."""
_MAX_PROTECTED = 1000


@dataclass(frozen=True)
class _FileIdentity:
    """The properties of a file that differ if it is replaced or changed."""

    device: int
    inode: int
    size: int  # bytes
    modified_ns: int  # when its contents changed, nanoseconds since 1970
    changed_ns: int  # when anything about it changed: this cannot be set back


class KeptCheckpoints:
    """Manages the folder with the checkpoints of one map; one process at a time may write to it.

    A locked file in it ensures this; the system releases the lock however the process ends.
    """

    def __init__(self, path: Path, retention: StoreSettings) -> None:
        """Lock the folder, which is made if need be; delete unfinished files in it.

        Raises:
            StoreError: another process has it locked.
            OSError: it cannot be written to.
        """
        path.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._lock = _locked(path / _LOCK)
        self._retention = retention
        self._needed: dict[Path, frozenset[str]] = {}  # names of each checkpoint's files
        self._identities: dict[str, _FileIdentity | None] = {}  # of files that were valid
        self._protected = ProtectedCheckpoints(path, retention.protect_h)
        for unfinished in _UNFINISHED:
            _delete(path.glob(unfinished))

    def close(self) -> None:
        """Release the folder."""
        self._lock.close()

    def renew_lock(self) -> None:
        """Lock the folder again if the locked file is no longer the one that others see.

        Deleting it, alone or with the folder, would let another process in.

        Raises:
            StoreError: another process has locked it first.
            OSError: the file cannot be made.
        """
        path = self.path / _LOCK
        if path.exists() and os.path.samestat(os.fstat(self._lock.fileno()), path.stat()):
            return
        lost, self._lock = self._lock, _locked(path)
        lost.close()

    def record(self, names: Iterable[str]) -> None:
        """Record files as they are now: they are valid."""
        for name in names:
            self._identities[name] = _file_identity(self.path / name)

    def add(self, path: Path, files: frozenset[str]) -> None:
        """Record a checkpoint that was just written and consists of ``files``."""
        self._needed[path] = files
        self.record([path.name])

    def unchanged(self, names: Iterable[str]) -> bool:
        """Return whether files exist, and are as they were when they were recorded."""
        for name in names:
            identity = _file_identity(self.path / name)
            if identity is None or identity != self._identities.get(name):
                return False
        return True

    def delete_old(self, newest: int) -> None:
        """Delete the files that are needed by none of the checkpoints that stay.

        Only those up to the epoch ``newest`` are counted and deleted: a file with a higher number
        is damaged, or not this server's, and must not push out a valid checkpoint.
        """
        try:
            files = [file for file in checkpoint_files(self.path) if file.epoch <= newest]
            sizes = {file.path.name: file.path.stat().st_size for file in files}
            checkpoints = [self._kept(file) for file in newest_of_each(files)]
        except OSError as error:
            _log.warning("old checkpoints in %s stay: %s", self.path, error)
            return
        self._protected.renew(checkpoint.epoch for checkpoint in checkpoints)
        needed = needed_files(
            checkpoints,
            sizes,
            self._retention,
            protected=self._protected.epochs,
            now_ns=time.time_ns(),
        )
        old = [file.path for file in files if file.path.name not in needed]
        for path in old:
            self._needed.pop(path, None)
            self._identities.pop(path.name, None)
        _delete(old)

    @property
    def restored(self) -> Restored | None:
        """The last time that the map was restored."""
        return self._protected.restored

    def protect(self, epoch: int, why: str, instead_of: int | None = None) -> None:
        """Have a checkpoint stay for ``protect_h``, whatever else retention says.

        The time of one that is protected already begins again. ``instead_of`` is one that may be
        deleted for it.

        Raises:
            StoreError: too much is protected already.
            OSError: this cannot be recorded, and does not count.
        """
        already = self._protected.epochs
        if epoch not in already:
            self._check_protected(epoch, already - {instead_of})
        self._protected.add(epoch, why)
        if instead_of in already:
            self._protected.remove(instead_of)

    def protect_restored(self, restored: Restored, why: str) -> None:
        """Record that the map was restored to an older checkpoint; the copy stays, too.

        Raises:
            OSError: this cannot be recorded.
        """
        self._protected.set_restored(restored, why)

    def _check_protected(self, epoch: int, others: frozenset[int]) -> None:
        """Raise an error unless there is room for one more to protect; the first always has."""
        limit = self._retention.protect_bytes
        files = [f for f in checkpoint_files(self.path) if f.epoch == epoch or f.epoch in others]
        names = frozenset().union(*(self._needed_by(file) for file in newest_of_each(files)))
        sizes = {name: path.stat().st_size for name in names if (path := self.path / name).exists()}
        used = bytes_of(names, sizes)
        too_large = 0 < limit < used
        if others and (too_large or len(others) >= _MAX_PROTECTED):
            raise StoreError(
                f"{len(others)} checkpoints are protected already, with this one {used:,} bytes, "
                f"and store.protect_bytes = {limit:,} (and {_MAX_PROTECTED:,} checkpoints) is the "
                f"limit; the first becomes free in {self._protected.first_ends_h:.1f} h: wait, "
                "raise the limit, or lower store.protect_h"
            )

    def _kept(self, file: CheckpointFile) -> KeptCheckpoint:
        stamp_ns = file.path.stat().st_mtime_ns
        return KeptCheckpoint(file.epoch, stamp_ns, files=self._needed_by(file))

    def _needed_by(self, file: CheckpointFile) -> frozenset[str]:
        """Return the names of the files that a checkpoint consists of."""
        if file.path not in self._needed:
            names = {file.path.name}
            # One that cannot be opened needs nothing any more.
            with contextlib.suppress(MapFileError):
                names |= set(open_manifest(file).files)
            self._needed[file.path] = frozenset(names)
        return self._needed[file.path]


def _file_identity(path: Path) -> _FileIdentity | None:
    """Return the file as it is now; ``None`` if none can be seen."""
    try:
        status = path.stat()
    except OSError:
        return None
    return _FileIdentity(
        status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    )


def _delete(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s is not needed, but cannot be deleted: %s", path, error)


def _locked(path: Path) -> IO[bytes]:
    file = path.open("a+b")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise StoreError(
            f"store {path.parent} is in use by another server: stop that one first, or give "
            "another --store or --map"
        ) from None
    return file
