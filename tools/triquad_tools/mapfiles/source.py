"""Where a map is read from: a file with those that it needs, or a folder of checkpoints."""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import NoIndexError
from triquad_format.mapfile.checkpoint_folder import (
    checkpoint_at,
    checkpoint_file,
    checkpoint_files,
    map_folder,
)
from triquad_format.mapfile.files import FileBytes, named
from triquad_format.mapfile.index import MapIndex, file_in
from triquad_format.mapfile.parts.part import TRAINING_TOPICS
from triquad_format.mapfile.reader import MapFile, read_map_file
from triquad_format.records.crop import crop_record, without_training
from triquad_format.records.region import MapRecord
from triquad_map.stored_map import StoredMap

from triquad_tools.console.command import ToolError

Box = NDArray[np.float64]
"""Opposite corners ``[2, 3]`` of a box, metres, map frame; the lower one first."""


class MissingFilesError(ToolError):
    """A map file whose parts lie in files that are not there."""


class NothingLeftError(ToolError):
    """A box in which a map has nothing."""


@dataclass(frozen=True)
class SourceMap:
    """A map to be written otherwise."""

    record: MapRecord
    stamp_ns: int | None  # when its epoch was written, nanoseconds since 1970


def chosen_file(path: Path, when: str | None) -> Path:
    """The file itself, or the checkpoint in a folder that ``when`` asks for.

    Args:
        path: a map file, a folder of checkpoints, or a store that holds one such folder.
        when: number of an epoch, or a time; not given, the newest checkpoint is meant.

    Raises:
        ToolError: ``when`` is given for a file.
        FormatError: the folder has no such checkpoint.
        OSError: the folder cannot be read.
    """
    if not path.is_dir():
        if when is not None:
            raise ToolError(f"{path} is one map file: --at asks for a folder of checkpoints")
        return path
    folder = map_folder(path)
    return (checkpoint_files(folder)[0] if when is None else checkpoint_at(folder, when)).path


def epoch_of(path: Path) -> int | None:
    """The epoch in the name of a checkpoint; ``None`` for another file."""
    checkpoint = checkpoint_file(path)
    return None if checkpoint is None else checkpoint.epoch


def read_whole(path: Path) -> MapFile:
    """The map in a file, checked.

    Raises:
        MissingFilesError: it needs other files that are not in its folder; the text names them.
        ToolError: it is a folder.
        MapFileError: it is not a map file, is damaged, or needs a newer reader.
        OSError: it cannot be read.
    """
    if path.is_dir():
        raise ToolError(f"{path} is a folder: --log lists the checkpoints in it")
    missing = [name for name in _needed_files(path) if not file_in(path.parent, name).exists()]
    if missing:
        raise MissingFilesError(
            f"{path} needs {', '.join(missing)}: not in its folder, copy what is missing there"
        )
    return read_map_file(path)


def read_source(path: Path, box: Box | None, training: bool) -> SourceMap:
    """The map in a file, cropped to a box.

    Of a file with an index only the parts that the box needs are read, unless training state is
    to be kept.

    Args:
        path: the file.
        box: not given, all of the map is read.
        training: whether training state is kept where there is some.

    Raises:
        NothingLeftError: no region lies in the box.
        FormatError: the box is empty, or the file cannot be read.
        ToolError: it needs other files, which are missing.
        OSError: it cannot be read.
    """
    source = None if box is None else _box(path, box, training)
    return cropped(source or _whole(path), box, training)


def cropped(source: SourceMap, box: Box | None, training: bool) -> SourceMap:
    """The map within a box, with or without training state; errors as :func:`read_source`."""
    record = source.record if box is None else crop_record(source.record, box[0], box[1])
    if source.record.has_evidence and not record.has_evidence:
        raise NothingLeftError("nothing of the map lies in the box")
    return SourceMap(record if training else without_training(record), source.stamp_ns)


def _whole(path: Path) -> SourceMap:
    file = read_whole(path)
    return SourceMap(file.record, file.manifest.stamp_ns or None)


def _box(path: Path, box: Box, training: bool) -> SourceMap | None:
    """What answers in a box; ``None`` where the file has to be read whole."""
    try:
        with StoredMap.open(path) as stored:
            topics = {entry.key.topic for entry in stored.manifest.entries}
            if training and topics & set(TRAINING_TOPICS):
                return None
            return SourceMap(stored.box(box[0], box[1]), stored.manifest.stamp_ns or None)
    except NoIndexError:
        return None


def _needed_files(path: Path) -> list[str]:
    with closing(FileBytes(path)) as source, named(str(path)):
        try:
            return [file.name for file in MapIndex(source).manifest.files]
        except NoIndexError:
            return []
