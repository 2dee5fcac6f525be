"""The history of a map: the checkpoints of a folder, from their manifests."""

import dataclasses
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
from triquad_format.mapfile.parts.part import REGION_TOPICS
from triquad_format.mapfile.protections import read_protections
from triquad_format.records.field_settings import RegionIndex

from triquad_tools.console.lines import print_line
from triquad_tools.console.report import print_columns


@dataclass(frozen=True)
class LoggedParts:
    """The content of a manifest."""

    time: str | None  # of the epoch, UTC as in RFC 3339
    stored: int  # parts in the file
    total: int  # parts of the map
    changed_regions: tuple[RegionIndex, ...]  # in which something changed with this epoch
    other_files: tuple[str, ...]  # that are needed


@dataclass(frozen=True)
class LoggedCheckpoint:
    """One checkpoint of a folder."""

    file: str
    epoch: int
    complete: bool  # whether it needs no other file
    bytes: int
    parts: LoggedParts | None  # None: it does not open
    problem: str | None  # why it does not open
    protected: str | None = None  # why retention keeps it for a while, whatever its limits


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
    indices = _Indices(folder)
    protected = {one.epoch: one.why for one in read_protections(folder).checkpoints}
    checkpoints = tuple(
        dataclasses.replace(_logged(file, indices), protected=protected.get(file.epoch))
        for file in checkpoint_files(folder)
    )
    return StoreLog(
        str(folder),
        bytes=sum(checkpoint.bytes for checkpoint in checkpoints),
        checkpoints=checkpoints,
        set_aside=tuple(path.name for path in set_aside(folder)),
    )


def print_log(log: StoreLog) -> None:
    """Print a table of the checkpoints, and what is wrong with those that do not open."""
    print_line(f"{log.folder}: {len(log.checkpoints)} checkpoints, {log.bytes:,} bytes")
    titles = ("epoch", "time", "kind", "bytes", "parts stored", "of", "regions changed", "opens")
    print_columns(titles, [_row(checkpoint) for checkpoint in log.checkpoints])
    for checkpoint in log.checkpoints:
        if checkpoint.problem is not None:
            print_line(f"  {checkpoint.file}: {checkpoint.problem}")
        if checkpoint.protected is not None:
            print_line(f"  {checkpoint.file}: protected, {checkpoint.protected}")
    for name in log.set_aside:
        print_line(f"  {name}: set aside as damaged; triquad-pack --recover saves what is intact")


def _row(checkpoint: LoggedCheckpoint) -> tuple[str, ...]:
    parts = checkpoint.parts
    told = ("-", "-", "-")
    if parts is not None:
        told = (f"{parts.stored:,}", f"{parts.total:,}", str(len(parts.changed_regions)))
    return (
        str(checkpoint.epoch),
        (parts and parts.time) or "-",
        "complete" if checkpoint.complete else "delta",
        f"{checkpoint.bytes:,}",
        *told,
        "no" if checkpoint.problem else "yes",
    )


def _logged(file: CheckpointFile, indices: "_Indices") -> LoggedCheckpoint:
    size, parts, problem = 0, None, None
    try:
        size = file.path.stat().st_size
        parts = indices.parts(file.path.name)
    except (FormatError, OSError) as error:
        problem = str(error)
    return LoggedCheckpoint(
        file.path.name, file.epoch, file.complete, bytes=size, parts=parts, problem=problem
    )


class _Indices:
    """The indices of a folder's files; each is read once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[str, MapIndex] = {}

    def parts(self, name: str) -> LoggedParts:
        """Return the content of a file's manifest, if all of its parts are to be found."""
        manifest = self._index(name).manifest
        for file in manifest.files:
            self._check_base(manifest, file)
        epoch = manifest.facts.epoch
        new = [entry.key for entry in manifest.entries if entry.epoch == epoch]
        return LoggedParts(
            time=utc_time(manifest.stamp_ns) if manifest.stamp_ns else None,
            stored=len(manifest.own),
            total=len(manifest.entries),
            changed_regions=tuple(sorted({k.region for k in new if k.topic in REGION_TOPICS})),
            other_files=manifest.files,
        )

    def _check_base(self, manifest: Manifest, file: str) -> None:
        """Raise unless the file of this name has the parts that it should have, where they are."""
        try:
            index = self._index(file)
        except FileNotFoundError as error:
            raise MapFileError(f"it needs {file}, which is missing") from error
        except (FormatError, OSError) as error:
            raise MapFileError(f"it needs {file}: {error}") from error
        places = {e.key: (e.sha256, e.offset, e.stored) for e in index.manifest.own}
        wanted = [entry for entry in manifest.entries if entry.file == file]
        if any(places.get(e.key) != (e.sha256, e.offset, e.stored) for e in wanted):
            raise MapFileError(f"it needs {file}, but not the file that now has this name")

    def _index(self, name: str) -> MapIndex:
        if name not in self._read:
            with closing(FileBytes(self._folder / name)) as source:
                self._read[name] = MapIndex(source)
        return self._read[name]
