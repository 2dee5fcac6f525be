"""Reads the newest valid checkpoint of a folder."""

import hashlib
import logging
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import (
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.checkpoint_folder import CheckpointFile, checkpoint_files
from triquad_format.mapfile.files import DAMAGED_SUFFIX
from triquad_format.mapfile.index import Checkpoint, read_checkpoint
from triquad_format.mapfile.reader import MapFile, StoredMap, read_map_file
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord
from triquad_format.wire.messages import CheckpointInfo

from triquad_server.errors import StoreError

_log = logging.getLogger(__name__)

MAX_EPOCH = 2**52
"""A map goes on from epochs below this: at a million a second, that is enough for 140 years. Those
above were not counted by any server, and would end where no client takes numbers any more."""


@dataclass(frozen=True)
class ValidCheckpoint:
    """A checkpoint that was read."""

    path: Path
    file: MapFile
    checkpoint: Checkpoint | None  # None: it is a map file, such as a backup
    info: CheckpointInfo

    @property
    def record(self) -> MapRecord:
        """Return the map in it."""
        return self.file.record


def newest_valid(folder: Path) -> ValidCheckpoint | None:
    """Return the newest valid checkpoint, or ``None`` if there are no checkpoints at all.

    Damaged ones are renamed, so that they are kept but never count as checkpoints again.

    Raises:
        StoreError: there are checkpoints but all are damaged; or the newest one cannot be read for
            a reason that says nothing against the file: it needs a newer release, it is too large,
            or the system refuses.
    """
    damaged: list[Path] = []
    try:
        checkpoints = checkpoint_files(folder)
    except OSError as error:
        raise StoreError(f"store {folder} cannot be read: {error}") from error
    for checkpoint in checkpoints:
        file = _read(checkpoint)
        if file is None:
            damaged.append(checkpoint.path)
            continue
        _set_aside(damaged)
        if damaged:
            _log.warning("the older checkpoint %s is used instead", checkpoint.path)
        return _valid(checkpoint.path, file)
    if damaged:
        raise StoreError(
            f"all {len(damaged)} checkpoints in {folder} are damaged; move them away to "
            "start with an empty map"
        )
    return None


def valid_checkpoint(checkpoint: CheckpointFile) -> ValidCheckpoint:
    """Read a chosen checkpoint.

    Raises:
        StoreError: it is damaged, or cannot be read.
    """
    file = _read(checkpoint)
    if file is None:
        raise StoreError(
            f"checkpoint {checkpoint.path} is damaged: choose another; triquad-pack --recover "
            "saves what is intact"
        )
    return _valid(checkpoint.path, file)


def regions_of(checkpoint: CheckpointFile, wanted: Collection[RegionIndex]) -> MapRecord:
    """Read some regions of a chosen checkpoint; those that it lacks are left out.

    Raises:
        FormatError: it is damaged.
        StoreError: it holds another epoch than its name says.
        OSError: it cannot be read.
    """
    with StoredMap.open(checkpoint.path) as stored:
        if (epoch := stored.manifest.facts.epoch) != checkpoint.epoch:
            raise StoreError(f"checkpoint {checkpoint.path} holds epoch {epoch}")
        return stored.regions(wanted)


def check_countable(path: Path, epoch: int) -> None:
    """Raise :class:`StoreError` unless a map can go on from ``epoch``, the one of ``path``."""
    if epoch >= MAX_EPOCH:
        raise StoreError(
            f"checkpoint {path} holds epoch {epoch}, and no map can go on from there: the number "
            f"must be less than {MAX_EPOCH}. No server came so far: move the file away to go on "
            "from an older one"
        )


def _read(checkpoint: CheckpointFile) -> MapFile | None:
    """Read a checkpoint; return ``None`` if it is damaged or not what its name says.

    Raises:
        StoreError: it cannot be read now, though it may well be valid; or a map cannot go on from
            its epoch.
    """
    path = checkpoint.path
    try:
        file = read_map_file(path)
    except UnsupportedMapFileError as error:
        raise StoreError(f"checkpoint {path} needs a newer release: {error}") from error
    except (TooLargeMapFileError, OSError) as error:
        raise StoreError(f"checkpoint {path} cannot be read: {error}") from error
    except MapFileError as error:
        _log.warning("checkpoint %s is damaged and left out: %s", path, error)
        return None
    epoch = file.record.epoch
    if epoch != checkpoint.epoch:
        _log.warning(
            "checkpoint %s holds epoch %d and is left out; name it epoch-%09d%s to use it",
            *(path, epoch, epoch, path.suffix),
        )
        return None
    check_countable(path, epoch)
    return file


def _set_aside(damaged: list[Path]) -> None:
    try:
        for path in damaged:
            aside = path.with_name(path.name + DAMAGED_SUFFIX)
            path.rename(aside)
            _log.warning("%s is now called %s", path, aside.name)
    except OSError as error:
        raise StoreError(f"the damaged {path} cannot be renamed: {error}") from error


def _valid(path: Path, file: MapFile) -> ValidCheckpoint:
    info = CheckpointInfo(
        path=str(path),
        bytes=file.size,
        epoch=file.record.epoch,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        stamp_ns=file.manifest.stamp_ns,
    )
    return ValidCheckpoint(path, file, read_checkpoint(path), info)
