"""The history of a map: the checkpoints of a folder, from the lists of their parts."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile import checkpoint_folder
from triquad_format.mapfile.files import FileBytes, named
from triquad_format.mapfile.index import CheckpointIndex, open_index
from triquad_format.mapfile.metadata import utc_time

from triquad_tools.console.command import print_line
from triquad_tools.console.report import print_columns


@dataclass(frozen=True)
class LoggedCheckpoint:
    """One checkpoint of a folder."""

    file: str
    epoch: int
    time: str | None = None  # of the epoch, UTC as in RFC 3339
    bytes: int = 0  # of all its parts, as they are stored
    new_bytes: int = 0  # of those that changed with it
    undoes: str = ""  # what going back to it undoes, such as a reset; empty: nothing
    problem: str | None = None  # why it does not open, or is not whole


@dataclass(frozen=True)
class StoreLog:
    """The checkpoints of a folder, newest first."""

    folder: str
    bytes: int
    checkpoints: tuple[LoggedCheckpoint, ...]
    set_aside: tuple[str, ...] = ()  # names of files that a server found damaged


def read_log(store: Path) -> StoreLog:
    """Return the checkpoints of a folder, or of the only map in a server's store.

    Parts are not read, but searched for.

    Raises:
        MapFileError: there are no checkpoints, or those of several maps.
        OSError: the folder cannot be read.
    """
    folder = checkpoint_folder.map_folder(store)
    parts_folder = checkpoint_folder.PartFiles(folder).folder
    files = [*folder.iterdir(), *(parts_folder.iterdir() if parts_folder.is_dir() else ())]
    return StoreLog(
        str(folder),
        bytes=sum(path.stat().st_size for path in files if path.is_file()),
        checkpoints=tuple(_logged(file) for file in checkpoint_folder.checkpoint_files(folder)),
        set_aside=tuple(path.name for path in checkpoint_folder.set_aside(folder)),
    )


def print_log(log: StoreLog) -> None:
    """Print a table of the checkpoints, and what is wrong with those that do not open."""
    print_line(f"{log.folder}: {len(log.checkpoints)} checkpoints, {log.bytes:,} bytes")
    rows = []
    for one in log.checkpoints:
        opens = "no" if one.problem else "yes"
        sizes = f"{one.bytes:,}", f"{one.new_bytes:,}"
        rows.append((f"{one.epoch}", one.time or "-", *sizes, opens))
    print_columns(("epoch", "time", "bytes", "new bytes", "opens"), rows)
    for checkpoint in log.checkpoints:
        if checkpoint.problem is not None:
            print_line(f"  {checkpoint.file}: {checkpoint.problem}")
        if checkpoint.undoes:
            print_line(f"  {checkpoint.file}: kept, to undo {checkpoint.undoes}")
    for name in log.set_aside:
        print_line(f"  {name}: set aside as damaged; triquad-pack --recover saves what is intact")


def _logged(file: checkpoint_folder.CheckpointFile) -> LoggedCheckpoint:
    try:
        with closing(FileBytes(file.path)) as source, named(str(file.path)):
            index = open_index(source)
            in_store = index if isinstance(index, CheckpointIndex) else None
            missing = len(in_store.missing()) if in_store else 0
    except (FormatError, OSError) as error:
        return LoggedCheckpoint(file.path.name, file.epoch, problem=str(error))
    manifest = index.manifest
    return LoggedCheckpoint(
        file.path.name,
        file.epoch,
        time=utc_time(manifest.stamp_ns) if manifest.stamp_ns else None,
        bytes=manifest.stored_bytes,
        new_bytes=sum(e.stored for e in manifest.entries if e.epoch == manifest.facts.epoch),
        undoes=in_store.checkpoint.undoes if in_store else "",
        problem=f"{missing} of its {len(manifest.entries)} parts are missing" if missing else None,
    )
