"""The lock of a map's folder: one server at a time has it."""

import fcntl
import os
from pathlib import Path
from typing import IO

from triquad_server.errors import StoreInUseError

_NAME = "lock"


class StoreLock:
    """Holds a locked file in the folder; the system releases it however the process ends."""

    def __init__(self, folder: Path) -> None:
        """Lock the folder.

        Raises:
            StoreInUseError: another process has it locked.
            OSError: the file cannot be made.
        """
        self._path = folder / _NAME
        self._file = _locked(self._path)

    def close(self) -> None:
        """Release the folder."""
        self._file.close()

    def renew(self) -> None:
        """Lock the folder again if the locked file is no longer the one that others see.

        Deleting it, alone or with the folder, would let another process in.

        Raises:
            StoreInUseError: another process has locked it first.
            OSError: the file cannot be made.
        """
        path = self._path
        if path.exists() and os.path.samestat(os.fstat(self._file.fileno()), path.stat()):
            return
        lost, self._file = self._file, _locked(path)
        lost.close()


def _locked(path: Path) -> IO[bytes]:
    file = path.open("a+b")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        if not isinstance(error, BlockingIOError | PermissionError):  # of SMB the latter
            raise
        raise StoreInUseError(
            f"store {path.parent} is in use by another server: stop that one first, or give "
            "another --store or --map"
        ) from None
    return file
