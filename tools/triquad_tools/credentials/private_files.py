"""Files that their owner alone may read."""

import os
import secrets
from pathlib import Path

_MODE = 0o600
_FOLDER_MODE = 0o700


def create_folder(path: Path) -> None:
    """Make a new folder, and those above it.

    Raises:
        FileExistsError: it is there already.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(mode=_FOLDER_MODE)


def write(path: Path, data: bytes) -> None:
    """Write a file, all of it or nothing; what was there before is replaced.

    Nobody else can read it at any time.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _MODE)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
