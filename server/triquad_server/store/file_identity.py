"""What tells a file from one that was put in its place, or changed."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class FileIdentity:
    """A file as it was at one time."""

    device: int
    inode: int
    size: int  # bytes
    modified_ns: int  # nanoseconds since 1970
    changed_ns: int  # the same, of anything about it: nobody can set this back


def file_identity(path: Path) -> FileIdentity | None:
    """The file as it is now; ``None`` where there is none to be seen."""
    try:
        status = path.stat()
    except OSError:
        return None
    return FileIdentity(
        status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    )
