"""Checkpoints on disk: one folder per map.

A checkpoint holds what changed since the one before and refers to older files for the rest; now
and then all is folded into one file. How far back they reach, the retention decides.
"""

import contextlib
import hashlib
import itertools
import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import (
    FormatError,
    MapFileError,
    TooLargeMapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.history import (
    CheckpointFile,
    checkpoint_file,
    checkpoint_files,
    checkpoint_name,
    newest_of_each,
    open_manifest,
)
from triquad_format.mapfile.index import DAMAGED_SUFFIX, OtherFiles, files_in
from triquad_format.mapfile.manifest import FileRef
from triquad_format.mapfile.map_facts import MapFacts
from triquad_format.mapfile.mapfile import MapFile, read_map_file
from triquad_format.mapfile.writer import write_parts
from triquad_format.mapfile.written_map import WrittenMap
from triquad_format.records.record_check import check_record
from triquad_format.records.region import MapRecord
from triquad_format.wire.messages import CheckpointInfo

from triquad_server.errors import StoreBaseError, StoreError
from triquad_server.mapping.mapper import MapChanges
from triquad_server.mesh.preview import preview_schema
from triquad_server.store.checkpoint_parts import (
    StoppedError,
    checkpoint_parts,
    copied_parts,
    unless,
)
from triquad_server.store.file_identity import FileIdentity, file_identity
from triquad_server.store.folder_lock import FolderLock
from triquad_server.store.known_parts import KnownParts, known_parts, own_bytes
from triquad_server.store.retention import KeptCheckpoint, Retention
from triquad_server.store.stamp import stamp_now_ns

_log = logging.getLogger(__name__)

_UNFINISHED = ".epoch-*.tmp"  # left by a server that was killed while it wrote
_READ_BYTES = 2**20


@dataclass(frozen=True)
class Restored:
    """A checkpoint that was read."""

    record: MapRecord
    info: CheckpointInfo


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
        self._identities: dict[str, FileIdentity | None] = {}  # of files that were sound
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = FolderLock(self.folder)
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be written to: {error}") from error
        _delete(self.folder.glob(_UNFINISHED))

    def close(self) -> None:
        """Let go of the folder."""
        self._lock.close()

    @property
    def base_epoch(self) -> int | None:
        """The epoch after which changes are enough for a checkpoint; ``None``: all is needed."""
        known = self._known
        if known is None or any(self._is_touched(name) for name in known.files):
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
            checkpoints = checkpoint_files(self.folder)
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
            StoreBaseError: older files cannot be read; all of the map is needed.
            StoreError: it could not be written; the older ones are untouched.
        """
        record = changes.record
        known = self._known
        changed = {region.index for region in record.regions}
        # Where most changed, the rest is copied, too: the checkpoint then needs no other.
        delta = known is not None and known.is_small(changed)
        path = self.folder / checkpoint_name(record.epoch, complete=not delta)
        stamp_ns = stamp_now_ns()
        try:
            self._lock.renew()
            check_record(record)
            with closing(OtherFiles(files_in(self.folder))) as others:
                written = write_parts(
                    path,
                    MapFacts(record.name, record.epoch, record.settings),
                    stamp_ns,
                    checkpoint_parts(changes, known, None if delta else others, stamp_ns),
                    {} if known is None else known.entries if delta else known.stored_here(),
                    preview_schema=preview_schema(),
                )
            info = _written_info(path, written)
        except MapFileError as error:
            self._known = None
            raise StoreBaseError(f"checkpoint {path} cannot be written: {error}") from error
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
            StoreBaseError: a file that holds parts cannot be read; all of the map is needed.
            StoreError: the file cannot be written.
        """
        known = self._known
        if known is None or not known.worth_folding:
            return None
        path = self.folder / checkpoint_name(known.facts.epoch, complete=True)
        try:
            self._lock.renew()
            with closing(OtherFiles(files_in(self.folder))) as others:
                parts = unless(stopping, copied_parts(known.entries.values(), others))
                here = known.stored_here()
                written = write_parts(
                    path, known.facts, known.stamp_ns, parts, here, preview_schema=preview_schema()
                )
            info = _written_info(path, written)
        except StoppedError:
            return None
        except MapFileError as error:
            self._known = None
            raise StoreBaseError(f"{path} cannot be folded: {error}") from error
        except (FormatError, OSError) as error:
            raise StoreError(f"{path} cannot be folded: {error}") from error
        self._newest_is(path, written, {})
        return info

    def _newest_is(self, path: Path, written: WrittenMap, held: Mapping[FileRef, int]) -> None:
        """Note what was written; let go of the oldest."""
        file = FileRef(path.name, written.manifest_sha256)
        self._known = known_parts(written.manifest, file, held)
        self._files[path] = self._known.files
        self._identities[path.name] = file_identity(path)
        self._tidy(self._known.facts.epoch)

    def _is_touched(self, name: str) -> bool:
        """Whether a file is gone, or not as it was when it was written or read."""
        identity = file_identity(self.folder / name)
        return identity is None or identity != self._identities.get(name)

    def _remember(self, checkpoint: CheckpointFile, file: MapFile) -> None:
        """Note what a checkpoint that was read consists of."""
        held = {}
        for other in file.manifest.files:
            base = checkpoint_file(self.folder / other.name)
            held[other] = 0 if base is None else own_bytes(open_manifest(base))
        own = FileRef(checkpoint.path.name, file.manifest_sha256)
        self._known = known_parts(file.manifest, own, held)
        for name in self._known.files:
            self._identities[name] = file_identity(self.folder / name)

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
            self._identities.pop(path.name, None)
        _delete(gone)

    def _needed_by(self, file: CheckpointFile) -> frozenset[str]:
        """Names of the files that a checkpoint consists of."""
        if file.path not in self._files:
            names = {file.path.name}
            # One that does not open needs nothing any more.
            with contextlib.suppress(MapFileError):
                names |= {other.name for other in open_manifest(file).files}
            self._files[file.path] = frozenset(names)
        return self._files[file.path]


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
            aside = path.with_name(path.name + DAMAGED_SUFFIX)
            for number in itertools.count(2):
                if not os.path.lexists(aside):
                    break
                aside = path.with_name(f"{path.name}.{number}{DAMAGED_SUFFIX}")
            path.rename(aside)
            _log.warning("%s is now called %s", path, aside.name)
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
