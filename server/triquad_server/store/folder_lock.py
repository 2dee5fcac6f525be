"""A folder that one process at a time may write to."""

import fcntl
import os
from pathlib import Path
from typing import IO

from triquad_server.errors import StoreError

_NAME = "lock"


class FolderLock:
    """Holds a folder by a locked file in it; the system lets go of it however the process ends."""

    def __init__(self, folder: Path) -> None:
        """Take the folder.

        Raises:
            StoreError: another process holds it.
            OSError: the file cannot be made.
        """
        self._path = folder / _NAME
        self._file: IO[bytes] = _locked(self._path)

    def renew(self) -> None:
        """Take the folder again where the locked file is no longer the one that others see.

        Whoever deletes it, alone or with the folder, would let another process in.

        Raises:
            StoreError: another process has come first.
            OSError: the file cannot be made.
        """
        locked = os.fstat(self._file.fileno())
        if self._path.exists() and os.path.samestat(locked, self._path.stat()):
            return
        lost, self._file = self._file, _locked(self._path)
        lost.close()

    def close(self) -> None:
        """Let go."""
        self._file.close()


def _locked(path: Path) -> IO[bytes]:
    file = path.open("a+b")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise StoreError(f"store {path.parent} is in use by another server") from None
    return file
