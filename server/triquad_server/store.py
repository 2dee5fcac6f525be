"""Checkpoints on disk: one folder per map.

A checkpoint holds what changed since the one before and refers to older files for the rest; now
and then all is folded into one file. How far back they reach, the retention decides.
"""

import fcntl
import hashlib
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from triquad_format.errors import (
    FormatError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.history import (
    CheckpointFile,
    checkpoint_file,
    checkpoint_files,
    checkpoint_name,
    newest_of_each,
    open_manifest,
)
from triquad_format.manifest import Entry, FileRef
from triquad_format.map_facts import MapFacts
from triquad_format.map_index import OtherFiles
from triquad_format.map_parts import pack_region
from triquad_format.mapfile import MapFile, read_map_file
from triquad_format.mapfile_reader import files_in
from triquad_format.mapfile_writer import WrittenMap, write_parts
from triquad_format.messages import CheckpointInfo
from triquad_format.part import MAP, Part
from triquad_format.part_body import repack_part
from triquad_format.preview import pack_preview
from triquad_format.record_check import check_record
from triquad_format.region import MapRecord

from triquad_server.errors import StoreError
from triquad_server.known_parts import KnownParts, known_parts, own_bytes
from triquad_server.mapper import MapChanges
from triquad_server.retention import KeptCheckpoint, Retention

_log = logging.getLogger(__name__)

_LOCK_NAME = "lock"
_UNFINISHED = ".epoch-*.tmp"  # left by a server that was killed while it wrote
_DAMAGED_SUFFIX = ".damaged"
_READ_BYTES = 2**20


@dataclass(frozen=True)
class Restored:
    """A checkpoint that was read."""

    record: MapRecord
    info: CheckpointInfo


class _FoldStoppedError(Exception):
    """Something is more urgent: folding is left for the next time."""


class Store:
    """The checkpoints of one map, for one thread. One server at a time holds the folder."""

    def __init__(self, root: Path, map_name: str, retention: Retention) -> None:
        """Take possession of ``root/map_name``, which is made if need be.

        Raises:
            StoreError: the folder cannot be written to, or another server holds it.
        """
        self.folder = root / map_name
        self._retention = retention
        self._known: KnownParts | None = None
        self._files: dict[Path, frozenset[str]] = {}  # that a checkpoint needs
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = (self.folder / _LOCK_NAME).open("a+b")
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be written to: {error}") from error
        if not _locked(self._lock):
            self._lock.close()
            raise StoreError(f"store {self.folder} is in use by another server")
        _delete(self.folder.glob(_UNFINISHED))

    def close(self) -> None:
        """Let go of the folder."""
        self._lock.close()

    @property
    def base_epoch(self) -> int | None:
        """The epoch after which changes are enough for a checkpoint; ``None``: all is needed."""
        known = self._known
        if known is None or not all((self.folder / name).is_file() for name in known.files):
            return None
        return known.facts.epoch

    def newest(self) -> Restored | None:
        """The newest sound checkpoint, or ``None`` where there are no checkpoints at all.

        Damaged ones are renamed, so that they are kept but never count as checkpoints again.

        Raises:
            StoreError: there are checkpoints but all are damaged; or the newest one cannot be
                read for a reason that says nothing against the file: it needs a newer release,
                it is too large, or the system refuses.
        """
        damaged: list[Path] = []
        try:
            checkpoints = newest_of_each(checkpoint_files(self.folder))
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be read: {error}") from error
        for checkpoint in checkpoints:
            file = _read(checkpoint)
            if file is None:
                damaged.append(checkpoint.path)
                continue
            _set_aside(damaged)
            if damaged:
                _log.warning("the older checkpoint %s is used instead", checkpoint.path)
            self._remember(checkpoint, file)
            return Restored(file.record, _info(checkpoint))
        if damaged:
            raise StoreError(
                f"all {len(damaged)} checkpoints in {self.folder} are damaged; move them away to "
                "start with an empty map",
            )
        return None

    def write(self, changes: MapChanges) -> CheckpointInfo:
        """Write a checkpoint of what changed since :attr:`base_epoch`; let go of the oldest.

        Raises:
            StoreError: it could not be written; the older ones are untouched.
        """
        record = changes.record
        known = self._known
        changed = {region.index for region in record.regions}
        # Where most changed, the rest is copied, too: the checkpoint then needs no other.
        delta = known is not None and known.is_small(changed)
        path = self.folder / checkpoint_name(record.epoch, complete=not delta)
        stamp_ns = time.time_ns()
        try:
            check_record(record)
            with closing(OtherFiles(files_in(self.folder))) as others:
                written = write_parts(
                    path,
                    MapFacts(record.name, record.epoch, record.settings),
                    stamp_ns,
                    _parts(changes, known, None if delta else others, stamp_ns),
                    {} if known is None else known.entries if delta else known.stored_here(),
                )
            info = _written_info(path, written)
        except (FormatError, OSError) as error:
            raise StoreError(f"checkpoint {path} cannot be written: {error}") from error
        except MemoryError as error:
            raise StoreError(f"checkpoint {path} cannot be written: out of memory") from error
        self._newest_is(path, written, {} if known is None else known.held)
        return info

    def fold(self, stopping: Callable[[], bool]) -> CheckpointInfo | None:
        """Put the newest checkpoint into one file, where that pays; the answer tells of it.

        It is left undone as soon as ``stopping()`` says so.

        Raises:
            StoreError: the file cannot be written, or one that holds parts cannot be read.
        """
        known = self._known
        if known is None or not known.worth_folding:
            return None
        path = self.folder / checkpoint_name(known.facts.epoch, complete=True)
        try:
            with closing(OtherFiles(files_in(self.folder))) as others:
                parts = _unless(stopping, _copied(known.entries.values(), others))
                here = known.stored_here()
                written = write_parts(path, known.facts, known.stamp_ns, parts, here)
            info = _written_info(path, written)
        except _FoldStoppedError:
            return None
        except (FormatError, OSError) as error:
            raise StoreError(f"{path} cannot be folded: {error}") from error
        self._newest_is(path, written, {})
        return info

    def _newest_is(self, path: Path, written: WrittenMap, held: Mapping[FileRef, int]) -> None:
        """Note what was written; let go of the oldest."""
        file = FileRef(path.name, written.manifest_sha256)
        self._known = known_parts(written.manifest, file, held)
        self._files[path] = self._known.files
        self._tidy(self._known.facts.epoch)

    def _remember(self, checkpoint: CheckpointFile, file: MapFile) -> None:
        """Note what a checkpoint that was read consists of."""
        if file.manifest is None:
            return
        held = {}
        for other in file.manifest.files:
            base = checkpoint_file(self.folder / other.name)
            manifest = None if base is None else open_manifest(base)
            held[other] = 0 if manifest is None else own_bytes(manifest)
        own = FileRef(checkpoint.path.name, file.manifest_sha256)
        self._known = known_parts(file.manifest, own, held)

    def _tidy(self, newest: int) -> None:
        """Delete the files that no checkpoint needs which is to stay.

        Only those up to the ``newest`` are counted and deleted: what bears a higher number is
        damaged, or not this server's, and must not push out a sound checkpoint.
        """
        try:
            files = [file for file in checkpoint_files(self.folder) if file.epoch <= newest]
            sizes = {file.path.name: file.path.stat().st_size for file in files}
            checkpoints = newest_of_each(files)
            asked = [
                KeptCheckpoint(file.path.stat().st_mtime_ns, self._needed_by(file))
                for file in checkpoints
            ]
        except OSError as error:
            _log.warning("old checkpoints in %s stay: %s", self.folder, error)
            return
        count = self._retention.kept(asked, sizes, time.time_ns())
        needed = frozenset().union(*(checkpoint.files for checkpoint in asked[:count]))
        gone = [file.path for file in files if file.path.name not in needed]
        for path in gone:
            self._files.pop(path, None)
        _delete(gone)

    def _needed_by(self, file: CheckpointFile) -> frozenset[str]:
        """Names of the files that a checkpoint consists of."""
        if file.path not in self._files:
            names = {file.path.name}
            try:
                manifest = open_manifest(file)
            except MapFileError:
                manifest = None  # damaged: it needs nothing any more
            if manifest is not None:
                names |= {other.name for other in manifest.files}
            self._files[file.path] = frozenset(names)
        return self._files[file.path]


def _parts(
    changes: MapChanges, known: KnownParts | None, others: OtherFiles | None, stamp_ns: int
) -> Iterator[Part | Entry]:
    """The parts of a checkpoint; those that did not change are copied from ``others``, if given."""
    changed = {region.index: region for region in changes.record.regions}
    settings = changes.record.settings
    for index in changes.regions:
        region = changed.get(index)
        if region is not None:
            yield from pack_region(region, settings)
            yield pack_preview(region, settings, changes.epoch.distances, stamp_ns)
        elif known is not None:
            entries = known.of_region(index)
            yield from entries if others is None else _copied(entries, others)


def _copied(entries: Iterable[Entry], others: OtherFiles) -> Iterator[Part]:
    """Parts that other files hold, read and checked; the map's own part is made anew."""
    for entry in entries:
        if entry.key.topic != MAP:
            yield repack_part(entry.key, others.payload(entry))


def _unless(stopping: Callable[[], bool], parts: Iterator[Part]) -> Iterator[Part]:
    for part in parts:
        if stopping():
            raise _FoldStoppedError
        yield part


def _written_info(path: Path, written: WrittenMap) -> CheckpointInfo:
    info = written.info
    return CheckpointInfo(str(path), info.bytes, info.epoch, info.sha256, path.stat().st_mtime_ns)


def _delete(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            _log.warning("%s is not needed, but cannot be deleted: %s", path, error)


def _read(checkpoint: CheckpointFile) -> MapFile | None:
    """A checkpoint, or ``None`` where it is damaged or not what its name says.

    Raises:
        StoreError: it cannot be read now, though it may well be sound.
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
    held = file.record.epoch
    if held != checkpoint.epoch:
        _log.warning(
            "checkpoint %s holds epoch %d and is left out; name it %s to use it",
            path,
            held,
            checkpoint_name(held, checkpoint.complete),
        )
        return None
    return file


def _set_aside(damaged: list[Path]) -> None:
    try:
        for path in damaged:
            path.rename(path.with_name(path.name + _DAMAGED_SUFFIX))
    except OSError as error:
        raise StoreError(f"the damaged {path} cannot be renamed: {error}") from error


def _info(checkpoint: CheckpointFile) -> CheckpointInfo:
    path = checkpoint.path
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_READ_BYTES):
            digest.update(block)
        size = file.tell()
        stamp_ns = os.fstat(file.fileno()).st_mtime_ns
    return CheckpointInfo(str(path), size, checkpoint.epoch, digest.hexdigest(), stamp_ns)


def _locked(file: IO[bytes]) -> bool:
    """Lock a file for this process; the system lets go of it however the process ends."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
