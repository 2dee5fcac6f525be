"""Reads the newest valid checkpoint of a folder."""

import hashlib
import logging
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import (
    DamagedMapFileError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.checkpoint_folder import (
    PARTS_NAME,
    CheckpointFile,
    PartFiles,
    checkpoint_files,
)
from triquad_format.mapfile.files import DAMAGED_SUFFIX
from triquad_format.mapfile.index import Checkpoint, read_checkpoint
from triquad_format.mapfile.manifest import Manifest
from triquad_format.mapfile.reader import StoredMap, read_map_file
from triquad_format.mapfile.region_facts import FactsByRegion
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord
from triquad_format.wire.messages import CheckpointInfo

from triquad_server.errors import StoreError

_log = logging.getLogger(__name__)

_MAPS_NAMED = 8  # maps of a store that are named where an epoch is not found

MAX_EPOCH = 2**52
"""A map goes on from epochs below this: at a million a second, that is enough for 140 years. Those
above were not counted by any server, and would end where no client takes numbers any more."""


@dataclass(frozen=True)
class ValidCheckpoint:
    """A checkpoint that a map can go on from."""

    path: Path
    manifest: Manifest
    record: MapRecord
    """The map. Of a checkpoint that tells of its regions it has none: they stay in the store until
    they are needed."""

    checkpoint: Checkpoint | None  # None: it is a map file, such as a backup
    info: CheckpointInfo

    @property
    def regions(self) -> FactsByRegion | None:
        """What is told of the regions that stay in the store; ``None``: the record has them."""
        return None if self.checkpoint is None else self.checkpoint.regions


def newest_valid(folder: Path) -> ValidCheckpoint | None:
    """Return the newest valid checkpoint, or ``None`` if there are no checkpoints at all.

    Damaged ones are renamed, so that they are kept but never count as checkpoints again. What is in
    the parts of regions is not looked at: :class:`triquad_server.store.stored_regions` does.

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
        valid = _opened(checkpoint)
        if valid is None:
            damaged.append(checkpoint.path)
            continue
        _set_aside(damaged)
        if damaged:
            _log.warning("the older checkpoint %s is used instead", checkpoint.path)
        return valid
    if damaged:
        raise StoreError(
            f"all {len(damaged)} checkpoints in {folder} are damaged; move them away to "
            "start with an empty map"
        )
    return None


def valid_checkpoint(checkpoint: CheckpointFile) -> ValidCheckpoint:
    """Open a chosen checkpoint, after a check of all of its parts.

    Raises:
        StoreError: it is damaged, or cannot be read.
    """
    valid = _opened(checkpoint)
    try:
        if valid is not None and valid.regions is not None:
            parts = PartFiles(checkpoint.path.parent)
            for entry in valid.manifest.entries:
                parts.check(entry.name)
    except DamagedMapFileError as error:
        _log.warning("checkpoint %s is damaged: %s", checkpoint.path, error)
        valid = None
    if valid is None:
        raise StoreError(
            f"checkpoint {checkpoint.path} is damaged: choose another; triquad-pack --recover "
            "saves what is intact"
        )
    return valid


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


def _opened(checkpoint: CheckpointFile) -> ValidCheckpoint | None:
    """Open a checkpoint; return ``None`` if it is damaged or not what its name says.

    Raises:
        StoreError: it cannot be read now, though it may well be valid; or a map cannot go on from
            its epoch.
    """
    path = checkpoint.path
    try:
        valid = _read(path)
    except UnsupportedMapFileError as error:
        raise StoreError(f"checkpoint {path} needs a newer release: {error}") from error
    except (TooLargeMapFileError, OSError) as error:
        raise StoreError(f"checkpoint {path} cannot be read: {error}") from error
    except MapFileError as error:
        _log.warning("checkpoint %s is damaged and left out: %s", path, error)
        return None
    epoch = valid.record.epoch
    if epoch != checkpoint.epoch:
        _log.warning(
            "checkpoint %s holds epoch %d and is left out; name it epoch-%09d%s to use it",
            *(path, epoch, epoch, path.suffix),
        )
        return None
    check_countable(path, epoch)
    return valid


def _read(path: Path) -> ValidCheckpoint:
    """Read what a map goes on from; errors are those of :func:`read_map_file`."""
    checkpoint = read_checkpoint(path)
    if checkpoint is None or checkpoint.regions is None:
        file = read_map_file(path)
        return _valid(path, file.manifest, file.record, checkpoint, file.size)
    manifest, parts = checkpoint.manifest, PartFiles(path.parent)
    if manifest.entries and not any(map(parts.has, manifest.entries)):
        raise DamagedMapFileError(f"none of its parts in {PARTS_NAME} is there, in its size")
    size = path.stat().st_size + manifest.stored_bytes
    return _valid(path, manifest, manifest.facts, checkpoint, size)


def _set_aside(damaged: list[Path]) -> None:
    try:
        for path in damaged:
            aside = path.with_name(path.name + DAMAGED_SUFFIX)
            path.rename(aside)
            _log.warning("%s is now called %s", path, aside.name)
    except OSError as error:
        raise StoreError(f"the damaged {path} cannot be renamed: {error}") from error


def _valid(
    path: Path, manifest: Manifest, record: MapRecord, checkpoint: Checkpoint | None, size: int
) -> ValidCheckpoint:
    info = CheckpointInfo(
        path=str(path),
        bytes=size,
        epoch=record.epoch,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        stamp_ns=manifest.stamp_ns,
    )
    return ValidCheckpoint(path, manifest, record, checkpoint, info)


def maps_beside(folder: Path) -> str:
    """Return which other maps of a store have checkpoints, where that of ``folder`` has none."""
    try:
        if checkpoint_files(folder):
            return ""
        folders = sorted(path for path in folder.parent.iterdir() if path.is_dir())
        names = [path.name for path in folders if checkpoint_files(path)]
    except OSError:
        return ""
    listed = ", ".join(names[:_MAPS_NAMED]) + (", ..." if len(names) > _MAPS_NAMED else "")
    return f"; the store has checkpoints of {listed}: name the map by --map" if names else ""
