"""The history of a map: the checkpoints of a folder, from the lists of their parts."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint import CheckpointIndex, open_index
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_files,
    map_folder,
    set_aside,
)
from triquad_format.mapfile.index import FileBytes, MapIndex, named
from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.part_files import PartFiles
from triquad_format.mapfile.parts.part import REGION_TOPICS
from triquad_format.records.field_settings import RegionIndex

from triquad_tools.console.lines import print_line
from triquad_tools.console.report import print_columns


@dataclass(frozen=True)
class LoggedParts:
    """The parts of a checkpoint."""

    time: str | None  # of the epoch, UTC as in RFC 3339
    total: int
    bytes: int  # of all of them, as they are stored
    changed: int  # with this epoch
    changed_bytes: int  # of these
    changed_regions: tuple[RegionIndex, ...]  # to which these belong
    missing: int  # that are not there; not known of a map file
    undoes: str  # what going back to it undoes, such as a reset; empty: nothing


@dataclass(frozen=True)
class LoggedCheckpoint:
    """One checkpoint of a folder."""

    file: str
    epoch: int
    parts: LoggedParts | None  # None: it does not open
    problem: str | None  # why it does not open, or is not whole


@dataclass(frozen=True)
class StoreLog:
    """The checkpoints of a folder, newest first."""

    folder: str
    bytes: int
    checkpoints: tuple[LoggedCheckpoint, ...]
    set_aside: tuple[str, ...] = ()  # names of files that a server found damaged

    @property
    def damaged(self) -> int:
        """The number of checkpoints that do not open."""
        return sum(checkpoint.problem is not None for checkpoint in self.checkpoints)


def read_log(store: Path) -> StoreLog:
    """Return the checkpoints of a folder, or of the only map in a server's store.

    Parts are not read, but searched for.

    Raises:
        MapFileError: there are no checkpoints, or those of several maps.
        OSError: the folder cannot be read.
    """
    folder = map_folder(store)
    parts_folder = PartFiles(folder).folder
    files = [*folder.iterdir(), *(parts_folder.iterdir() if parts_folder.is_dir() else ())]
    return StoreLog(
        str(folder),
        bytes=sum(path.stat().st_size for path in files if path.is_file()),
        checkpoints=tuple(_logged(file) for file in checkpoint_files(folder)),
        set_aside=tuple(path.name for path in set_aside(folder)),
    )


def print_log(log: StoreLog) -> None:
    """Print a table of the checkpoints, and what is wrong with those that do not open."""
    print_line(f"{log.folder}: {len(log.checkpoints)} checkpoints, {log.bytes:,} bytes")
    titles = ("epoch", "time", "bytes", "new bytes", "parts", "new", "regions changed", "opens")
    print_columns(titles, [_row(checkpoint) for checkpoint in log.checkpoints])
    for checkpoint in log.checkpoints:
        if checkpoint.problem is not None:
            print_line(f"  {checkpoint.file}: {checkpoint.problem}")
        if checkpoint.parts is not None and checkpoint.parts.undoes:
            print_line(f"  {checkpoint.file}: kept, to undo {checkpoint.parts.undoes}")
    for name in log.set_aside:
        print_line(f"  {name}: set aside as damaged; triquad-pack --recover saves what is intact")


def _row(checkpoint: LoggedCheckpoint) -> tuple[str, ...]:
    parts = checkpoint.parts
    told: tuple[str, ...] = ("-",) * 6
    if parts is not None:
        numbers = (parts.bytes, parts.changed_bytes, parts.total, parts.changed)
        amounts = [f"{number:,}" for number in (*numbers, len(parts.changed_regions))]
        told = (parts.time or "-", *amounts)
    return (str(checkpoint.epoch), *told, "no" if checkpoint.problem else "yes")


def _logged(file: CheckpointFile) -> LoggedCheckpoint:
    parts, problem = None, None
    try:
        with closing(FileBytes(file.path)) as source, named(str(file.path)):
            parts = _parts(open_index(source))
        if parts.missing:
            problem = f"{parts.missing} of its {parts.total} parts are missing"
    except (FormatError, OSError) as error:
        problem = str(error)
    return LoggedCheckpoint(file.path.name, file.epoch, parts, problem)


def _parts(index: MapIndex | CheckpointIndex) -> LoggedParts:
    manifest = index.manifest
    new = [entry for entry in manifest.entries if entry.epoch == manifest.facts.epoch]
    regions = {entry.key.region for entry in new if entry.key.topic in REGION_TOPICS}
    in_store = index if isinstance(index, CheckpointIndex) else None
    return LoggedParts(
        time=utc_time(manifest.stamp_ns) if manifest.stamp_ns else None,
        total=len(manifest.entries),
        bytes=manifest.stored_bytes,
        changed=len(new),
        changed_bytes=sum(entry.stored for entry in new),
        changed_regions=tuple(sorted(regions)),
        missing=len(in_store.missing()) if in_store else 0,
        undoes=in_store.checkpoint.undoes if in_store else "",
    )
