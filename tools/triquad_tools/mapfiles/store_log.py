"""The history of a map: the checkpoints of a folder, from their manifests."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import FormatError, MapFileError
from triquad_format.mapfile.checkpoint_folder import (
    CheckpointFile,
    checkpoint_files,
    map_folder,
    set_aside,
)
from triquad_format.mapfile.index import FileBytes, MapIndex
from triquad_format.mapfile.manifest import Manifest
from triquad_format.mapfile.metadata import utc_time
from triquad_format.mapfile.protections import read_protections

from triquad_tools.console.lines import print_line
from triquad_tools.console.report import print_columns


@dataclass(frozen=True)
class LoggedCheckpoint:
    """One checkpoint of a folder."""

    file: str
    epoch: int
    complete: bool  # whether it needs no other file
    bytes: int
    time: str | None  # of the epoch, UTC as in RFC 3339
    problem: str | None  # why it does not open
    protected: str | None  # why retention keeps it for a while, whatever its limits


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

    Parts are not read: only indices and manifests are, of the checkpoints and of what they need.

    Raises:
        MapFileError: there are no checkpoints, or those of several maps; or the list of those that
            are protected is damaged.
        OSError: the folder cannot be read.
    """
    folder = map_folder(store)
    manifests: dict[str, Manifest] = {}
    protected = {one.epoch: one.why for one in read_protections(folder).checkpoints}
    checkpoints = tuple(
        _logged(file, manifests, protected.get(file.epoch)) for file in checkpoint_files(folder)
    )
    size = sum(checkpoint.bytes for checkpoint in checkpoints)
    return StoreLog(str(folder), size, checkpoints, tuple(p.name for p in set_aside(folder)))


def print_log(log: StoreLog) -> None:
    """Print a table of the checkpoints, and what is wrong with those that do not open."""
    print_line(f"{log.folder}: {len(log.checkpoints)} checkpoints, {log.bytes:,} bytes")
    rows = [
        (
            str(one.epoch),
            one.time or "-",
            "complete" if one.complete else "delta",
            f"{one.bytes:,}",
            "no" if one.problem else "yes",
        )
        for one in log.checkpoints
    ]
    print_columns(("epoch", "time", "kind", "bytes", "opens"), rows)
    for checkpoint in log.checkpoints:
        if checkpoint.problem is not None:
            print_line(f"  {checkpoint.file}: {checkpoint.problem}")
        if checkpoint.protected is not None:
            print_line(f"  {checkpoint.file}: protected, {checkpoint.protected}")
    for name in log.set_aside:
        print_line(f"  {name}: set aside as damaged; triquad-pack --recover saves what is intact")


def _logged(
    file: CheckpointFile, manifests: dict[str, Manifest], protected: str | None
) -> LoggedCheckpoint:
    size, time, problem = 0, None, None
    try:
        size = file.path.stat().st_size
        manifest = _manifest(file.path, manifests)
        for other in manifest.files:
            _check_base(manifest, file.path.with_name(other), manifests)
        time = utc_time(manifest.stamp_ns) if manifest.stamp_ns else None
    except (FormatError, OSError) as error:
        problem = str(error)
    return LoggedCheckpoint(
        file.path.name, file.epoch, file.complete, size, time, problem, protected
    )


def _check_base(manifest: Manifest, file: Path, manifests: dict[str, Manifest]) -> None:
    """Raise unless a file has the parts that it should have, where they are."""
    try:
        base = _manifest(file, manifests)
    except FileNotFoundError as error:
        raise MapFileError(f"it needs {file.name}, which is missing") from error
    except (FormatError, OSError) as error:
        raise MapFileError(f"it needs {file.name}: {error}") from error
    places = {e.key: (e.sha256, e.offset, e.stored) for e in base.own}
    wanted = [entry for entry in manifest.entries if entry.file == file.name]
    if any(places.get(e.key) != (e.sha256, e.offset, e.stored) for e in wanted):
        raise MapFileError(f"it needs {file.name}, but not the file that now has this name")


def _manifest(path: Path, known: dict[str, Manifest]) -> Manifest:
    """Return the manifest of a file, which is read once."""
    if path.name not in known:
        with closing(FileBytes(path)) as source:
            known[path.name] = MapIndex(source).manifest
    return known[path.name]
