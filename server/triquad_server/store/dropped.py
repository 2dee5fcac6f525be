"""Where the folders of maps are kept that no server serves any more."""

from datetime import datetime, timezone
from pathlib import Path

_DROPPED = ".dropped"  # the folder of a store for these: no map has such a name


def set_aside(folder: Path) -> Path:
    """Move the folder of a map to where no map is looked for; return where it is.

    Raises:
        OSError: it cannot be moved.
    """
    now = datetime.now(timezone.utc)
    to = folder.parent / _DROPPED / f"{folder.name}-{now:%Y%m%dT%H%M%S.%fZ}"
    to.parent.mkdir(exist_ok=True)
    return folder.rename(to)
