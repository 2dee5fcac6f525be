"""Checkpoints on disk: one folder per map, the newest few map files in it."""

import fcntl
import hashlib
import logging
import os
import re
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from triquad_format.errors import (
    FormatError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile import read_map, write_map
from triquad_format.messages import CheckpointInfo
from triquad_format.region import MapRecord

from triquad_server.errors import StoreError

_log = logging.getLogger(__name__)

_NAME = re.compile(r"epoch-(\d{9,18})\.triquad")
_LOCK_NAME = "lock"
_UNFINISHED = ".epoch-*.tmp"  # left by a server that was killed while it wrote
_DAMAGED_SUFFIX = ".damaged"
_READ_BYTES = 2**20


@dataclass(frozen=True)
class Restored:
    """A checkpoint that was read."""

    record: MapRecord
    info: CheckpointInfo


class Store:
    """The checkpoints of one map. One server at a time holds the folder."""

    def __init__(self, root: Path, map_name: str, keep: int) -> None:
        """Take possession of ``root/map_name``, which is made if need be.

        Raises:
            StoreError: the folder cannot be written to, or another server holds it.
        """
        self.folder = root / map_name
        self._keep = keep
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / _LOCK_NAME).open("a+b")
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be written to: {error}") from error
        if not _locked(self._lock):
            self._lock.close()
            raise StoreError(f"store {self.folder} is in use by another server")
        _delete(self.folder.glob(_UNFINISHED))

    def close(self) -> None:
        """Let go of the folder."""
        self._lock.close()

    def newest(self) -> Restored | None:
        """The newest sound checkpoint, or ``None`` where there are no checkpoints at all.

        Damaged ones are renamed, so that they are kept but never count as checkpoints again.

        Raises:
            StoreError: there are checkpoints but all are damaged; or the newest one cannot be
                read for a reason that says nothing against the file: it needs a newer release,
                it is too large, or the system refuses.
        """
        damaged: list[Path] = []
        try:
            checkpoints = self._checkpoints()
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be read: {error}") from error
        for _, path in checkpoints:
            restored = _read(path)
            if restored is None:
                damaged.append(path)
                continue
            _set_aside(damaged)
            if damaged:
                _log.warning("the older checkpoint %s is used instead", path)
            return restored
        if damaged:
            raise StoreError(
                f"all {len(damaged)} checkpoints in {self.folder} are damaged; move them away to "
                "start with an empty map",
            )
        return None

    def write(self, record: MapRecord) -> CheckpointInfo:
        """Write a checkpoint and delete those beyond the number to keep.

        Raises:
            StoreError: it could not be written; the older ones are untouched.
        """
        path = self.folder / _name(record.epoch)
        try:
            older = [path for number, path in self._checkpoints() if number < record.epoch]
            file = write_map(record, path, stamp_ns=time.time_ns())
            stamp_ns = path.stat().st_mtime_ns
        except (FormatError, OSError) as error:
            raise StoreError(f"checkpoint {path} cannot be written: {error}") from error
        except MemoryError as error:
            raise StoreError(f"checkpoint {path} cannot be written: out of memory") from error
        # Only older ones are counted and deleted: what bears a higher number is damaged, or not
        # this server's, and must not push out a sound checkpoint.
        _delete(older[self._keep - 1 :])
        return CheckpointInfo(str(path), file.bytes, file.epoch, file.sha256, stamp_ns)

    def _checkpoints(self) -> list[tuple[int, Path]]:
        """Checkpoint files with their numbers, newest first."""
        found = [
            (int(match[1]), path)
            for path in self.folder.iterdir()
            if (match := _NAME.fullmatch(path.name))
        ]
        return sorted(found, reverse=True)


def _name(epoch: int) -> str:
    return f"epoch-{epoch:09d}.triquad"


def _delete(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s is not needed, but cannot be deleted: %s", path, error)


def _read(path: Path) -> Restored | None:
    """A checkpoint, or ``None`` where it is damaged or not what its name says.

    Raises:
        StoreError: it cannot be read now, though it may well be sound.
    """
    try:
        restored = Restored(read_map(path), _info(path))
    except UnsupportedMapFileError as error:
        raise StoreError(f"checkpoint {path} needs a newer release: {error}") from error
    except (TooLargeMapFileError, OSError) as error:
        raise StoreError(f"checkpoint {path} cannot be read: {error}") from error
    except MapFileError as error:
        _log.warning("checkpoint %s is damaged and left out: %s", path, error)
        return None
    held = restored.record.epoch
    if held != restored.info.epoch:
        _log.warning(
            "checkpoint %s holds epoch %d and is left out; name it %s to use it",
            path,
            held,
            _name(held),
        )
        return None
    return restored


def _set_aside(damaged: list[Path]) -> None:
    try:
        for path in damaged:
            path.rename(path.with_name(path.name + _DAMAGED_SUFFIX))
    except OSError as error:
        raise StoreError(f"the damaged {path} cannot be renamed: {error}") from error


def _info(path: Path) -> CheckpointInfo:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_READ_BYTES):
            digest.update(block)
        size = file.tell()
        stamp_ns = os.fstat(file.fileno()).st_mtime_ns
    match = _NAME.fullmatch(path.name)
    epoch = int(match[1]) if match else 0
    return CheckpointInfo(str(path), size, epoch, digest.hexdigest(), stamp_ns)


def _locked(file: IO[bytes]) -> bool:
    """Lock a file for this process; the system lets go of it however the process ends."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
