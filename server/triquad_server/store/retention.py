"""Retention: which checkpoints of a map are kept, and what is deleted once one was written."""

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import FormatError, TooLargeMapFileError, UnsupportedMapFileError
from triquad_format.mapfile.checkpoint_folder import (
    PartFiles,
    checkpoint_files,
    checkpoint_name,
    set_aside,
)
from triquad_format.mapfile.files import sync_folder
from triquad_format.mapfile.index import read_checkpoint

from triquad_server.settings import StoreSettings

_log = logging.getLogger(__name__)

_UNFINISHED = ".*.tmp"
"""The files left by a server that was killed, or whose disk was full, while it wrote."""

_MIN_KEPT = 2
"""The number of newest checkpoints that always stay: should one be damaged, there is another."""


@dataclass(frozen=True)
class StoredCheckpoint:
    """The properties of a checkpoint that decide whether it stays."""

    files: Mapping[str, int]  # bytes of each of its parts and of its own file, by name
    undoes: str = ""  # what going back to it undoes, such as a reset; empty: nothing
    restored_as: str = ""  # file of the checkpoint that a restored map went on from; empty: none


def staying(
    checkpoints: Sequence[StoredCheckpoint], settings: StoreSettings
) -> list[StoredCheckpoint]:
    """Return those of all checkpoints, the newest first, that stay.

    These are the two newest and, as long as ``keep_bytes`` suffice, first the newest
    ``keep_resets`` before them that undo something, then the one that the map was last restored as,
    then the newest ``keep`` of all.
    """
    undoing = [one for one in checkpoints[_MIN_KEPT:] if one.undoes][: settings.keep_resets]
    restored = [one for one in checkpoints if checkpoints[0].restored_as in one.files]
    files: dict[str, int] = {}
    stay: list[StoredCheckpoint] = []
    candidates = [*checkpoints[:_MIN_KEPT], *undoing, *restored, *checkpoints[: settings.keep]]
    for number, one in enumerate(candidates):
        files |= one.files
        if number >= _MIN_KEPT and 0 < settings.keep_bytes < sum(files.values()):
            break
        stay.append(one)
    return stay


def files_of(checkpoints: Iterable[StoredCheckpoint]) -> dict[str, int]:
    """Return the bytes of all files that checkpoints need; what they share is there once."""
    files: dict[str, int] = {}
    for checkpoint in checkpoints:
        files |= checkpoint.files
    return files


def delete_unfinished(folder: Path) -> None:
    """Delete files that were not written to their end."""
    _delete([*folder.glob(_UNFINISHED), *PartFiles(folder).folder.glob(_UNFINISHED)])


def delete_unneeded(
    folder: Path,
    settings: StoreSettings,
    newest: int | None = None,
    also_needed: Collection[str] = (),
) -> None:
    """Delete unfinished files, checkpoints that need not stay, and parts that none names any more.

    Parts that are ``also_needed`` stay, too, by their names.

    Without ``newest`` all checkpoints stay. Else those up to this epoch are counted and deleted: a
    file with a higher number is damaged, or not this server's, and must not push out a valid
    checkpoint. One that was set aside as damaged names its parts, too: the others can be saved.
    """
    delete_unfinished(folder)
    parts = PartFiles(folder)
    try:
        stored = {file: _read(file.path) for file in checkpoint_files(folder)}
        aside = [_read(path) for path in set_aside(folder)]
        if newest is not None:
            counted = [file for file in stored if file.epoch <= newest]
            names = files_of(staying([stored[file] for file in counted], settings))
            unneeded = [file for file in counted if file.path.name not in names]
            _delete(file.path for file in unneeded)
            stored = {file: one for file, one in stored.items() if file not in unneeded}
            # Else a power cut could leave a checkpoint whose parts are deleted.
            sync_folder(folder)
        needed = files_of([*stored.values(), *aside])
        unneeded_parts = parts.names() - needed.keys() - set(also_needed)
    except (FormatError, OSError) as error:
        _log.warning("checkpoints and parts in %s stay, needed or not: %s", folder, error)
        return
    _delete(parts.folder / name for name in unneeded_parts)


def _read(path: Path) -> StoredCheckpoint:
    """Return what is needed of the file of a checkpoint; one that is damaged names no parts.

    Raises:
        FormatError: it may be valid, but cannot be read by this release, or now.
        OSError: it cannot be read.
    """
    own = {path.name: path.stat().st_size}
    try:
        checkpoint = read_checkpoint(path)
    except (UnsupportedMapFileError, TooLargeMapFileError):
        raise
    except FormatError:
        return StoredCheckpoint(own)
    if checkpoint is None:
        return StoredCheckpoint(own)
    parts = {entry.name: entry.stored for entry in checkpoint.manifest.entries}
    restored = checkpoint.restored
    restored_as = "" if restored is None else checkpoint_name(restored.as_epoch)
    return StoredCheckpoint(own | parts, checkpoint.undoes, restored_as)


def _delete(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s is not needed, but cannot be deleted: %s", path, error)
