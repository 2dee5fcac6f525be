"""A folder of checkpoints: the epochs of a map that can be read back.

A server writes ``epoch-<number>.checkpoint``, which lists parts. A whole map file that is put there
as ``epoch-<number>.triquad``, such as a backup, counts as a checkpoint, too.
"""

import re
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import MapFileError
from triquad_format.mapfile.files import DAMAGED_SUFFIX, FileBytes, named
from triquad_format.mapfile.index import open_index
from triquad_format.mapfile.manifest import Manifest

_NAME = re.compile(r"epoch-([0-9]{9,19})\.(checkpoint|triquad)")

_LISTED = 40  # epochs in the text of an error


@dataclass(frozen=True, order=True)
class CheckpointFile:
    """A checkpoint, by its name."""

    epoch: int
    path: Path


def checkpoint_name(epoch: int) -> str:
    """Return the name of a checkpoint's file."""
    return f"epoch-{epoch:09d}.checkpoint"


def checkpoint_file(path: Path) -> CheckpointFile | None:
    """Return the checkpoint of that name; ``None`` where it is not the name of one."""
    match = _NAME.fullmatch(path.name)
    if match is None or int(match[1]) >= 2**63:
        return None
    return CheckpointFile(int(match[1]), path)


def checkpoint_files(folder: Path) -> list[CheckpointFile]:
    """Return the checkpoints in a folder, newest first.

    What is no file, or a link to none, is left out.

    Raises:
        OSError: the folder cannot be read.
    """
    found = [checkpoint_file(path) for path in folder.iterdir() if path.is_file()]
    return sorted((file for file in found if file is not None), reverse=True)


def set_aside(folder: Path) -> list[Path]:
    """Return checkpoints in a folder that a server found damaged and renamed, in order of names.

    Raises:
        OSError: the folder cannot be read.
    """
    ended = [path for path in folder.iterdir() if path.name.endswith(DAMAGED_SUFFIX)]
    return sorted(path for path in ended if checkpoint_file(path.with_suffix("")) is not None)


def map_folder(store: Path) -> Path:
    """Return the folder of checkpoints that ``store`` is, or the only one that it contains.

    Raises:
        MapFileError: there is none, or there are several; the text names them.
        OSError: the folder cannot be read.
    """
    if checkpoint_files(store):
        return store
    maps = sorted(path for path in store.iterdir() if path.is_dir() and checkpoint_files(path))
    if len(maps) != 1:
        names = ", ".join(path.name for path in maps) or "none"
        raise MapFileError(f"{store} is not a folder of checkpoints; maps in it: {names}")
    return maps[0]


def open_manifest(file: CheckpointFile) -> Manifest:
    """Return the manifest of a checkpoint; no part is read.

    Raises:
        MapFileError: the file is damaged, or needs a newer reader.
        OSError: it cannot be read.
    """
    with closing(FileBytes(file.path)) as source, named(str(file.path)):
        return open_index(source).manifest


def checkpoint_of(folder: Path, epoch: int) -> CheckpointFile:
    """Return the checkpoint of an epoch.

    Raises:
        MapFileError: there is none; the text says which there are.
        OSError: the folder cannot be read.
    """
    files = checkpoint_files(folder)
    for file in files:
        if file.epoch == epoch:
            return file
    there = ", ".join(str(file.epoch) for file in files[:_LISTED]) or "none"
    more = ", ..." if len(files) > _LISTED else ""
    raise MapFileError(f"{folder} holds no checkpoint of epoch {epoch}; there are: {there}{more}")
