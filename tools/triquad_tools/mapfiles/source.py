"""Sources of maps: a file, a folder of checkpoints, a server."""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from triquad_format.errors import MapFileError, TriquadError
from triquad_format.mapfile.checkpoint_folder import CheckpointFile, checkpoint_files, map_folder
from triquad_format.mapfile.reader import StoredMap, open_manifest, read_map_file
from triquad_format.records.arrays import Doubles
from triquad_format.records.region import MapRecord

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapfiles.crop import crop_record

Box = Doubles  # opposite corners [2, 3] of a box, metres, map frame; the lower one first
_ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|unixsock-stream)/")


class NothingLeftError(TriquadError):
    """A box in which a map has nothing, or nothing of what is asked for."""


@dataclass(frozen=True)
class SourceMap:
    """A map to be written otherwise."""

    record: MapRecord
    stamp_ns: int  # when its epoch was written, nanoseconds since 1970; 0: not known


def chosen_file(path: Path, when: str | None) -> Path:
    """Return the file itself or, for a folder of checkpoints or a store, the checkpoint ``when``.

    ``when`` is the number of an epoch, or a time; not given, the newest checkpoint is meant.

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


def is_endpoint(target: str) -> bool:
    """Return whether ``target`` is a Zenoh endpoint, and not the name of a file."""
    return _ENDPOINT.match(target) is not None


@contextmanager
def map_file(
    target: str, map_name: str, config: Path | None, *, when: str | None
) -> Iterator[Path]:
    """Yield a map's file: ``target`` itself, a checkpoint of it, or a server's newest epoch.

    The map ``map_name`` of a server, which is reached with a Zenoh configuration ``config``, is
    downloaded, and deleted afterwards. ``when`` says which checkpoint of a folder; see
    :func:`chosen_file`.

    Raises:
        ToolError: ``when`` is given, but ``target`` is no folder.
        TriquadError: no server there has the map.
        FormatError: the folder has no such checkpoint.
        OSError: it cannot be read.
    """
    if not is_endpoint(target):
        yield chosen_file(Path(target), when)
        return
    if when is not None:
        raise ToolError(f"{target} is a server, which has its newest epoch only: leave out --at")
    import triquad_client

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.triquad"
        connected = triquad_client.connect(target, map_name, config=config)
        with progress("downloading"), connected as client:
            client.download_map(path, training=True)
        yield path


def read_source(path: Path, box: Box | None) -> SourceMap:
    """Return the map in a file; in a box it is :func:`cropped`, and only what that needs is read.

    Raises:
        NothingLeftError: no region lies in the box.
    """
    if box is None:
        file = read_map_file(path)
        return SourceMap(file.record, file.manifest.stamp_ns)
    with StoredMap.open(path) as stored:
        return cropped(SourceMap(stored.box(*box), stored.manifest.stamp_ns), box)


def cropped(source: SourceMap, box: Box) -> SourceMap:
    """Return the map in a box, without training state; raises as :func:`read_source`."""
    record = crop_record(source.record, *box)
    if not record.regions or (source.record.has_evidence and not record.has_evidence):
        raise NothingLeftError("nothing of the map lies in the box of --crop")
    return SourceMap(record, source.stamp_ns)


def checkpoint_at(folder: Path, when: str) -> CheckpointFile:
    """Return the newest checkpoint that is not after ``when``.

    Args:
        folder: the folder of checkpoints.
        when: number of an epoch, or a time as in RFC 3339 (local time where it has no offset).

    Raises:
        MapFileError: ``when`` is neither, or there is no such checkpoint; the text says which
            there are.
        OSError: the folder or a file cannot be read.
    """
    files = checkpoint_files(folder)
    is_epoch = when.isascii() and when.isdigit() and len(when) < 20
    if is_epoch:
        found = [file for file in files if file.epoch <= int(when)]
    else:
        limit_s = _seconds(when)
        # Times are shown in whole seconds: what is shown must find its checkpoint.
        found = [file for file in files if 0 < _stamp_ns(file) // 10**9 <= limit_s]
    epochs = f"epochs {files[-1].epoch} to {files[0].epoch}" if files else "nothing"
    if not found:
        raise MapFileError(f"{folder} holds no checkpoint of {when} or before, but {epochs}")
    if is_epoch and int(when) > files[0].epoch:
        raise MapFileError(
            f"{folder} holds {epochs}, not {when}; a time is written as 2026-01-31T12:00:00Z"
        )
    return max(found)


def _seconds(when: str) -> float:
    try:
        return datetime.fromisoformat(when.replace("Z", "+00:00")).timestamp()
    except ValueError as error:
        raise MapFileError(
            f"{when!r} is neither the number of an epoch nor a time such as 2026-01-31T12:00:00Z"
        ) from error


def _stamp_ns(file: CheckpointFile) -> int:
    """Return when an epoch was written, nanoseconds since 1970; 0 where that is not known."""
    try:
        return open_manifest(file).stamp_ns
    except MapFileError:
        return 0
