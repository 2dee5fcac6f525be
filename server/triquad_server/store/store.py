"""Checkpoints on disk: one folder per map.

A checkpoint holds what changed since the one before and refers to older files for the rest; now
and then all is folded into one file. How far back they reach, the settings decide.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

from triquad_format.errors import FormatError, MapFileError
from triquad_format.mapfile.checkpoint_folder import checkpoint_file, checkpoint_name, open_manifest
from triquad_format.mapfile.index import OtherFiles, files_in
from triquad_format.mapfile.manifest import FileRef
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.writer import WrittenMap, write_parts
from triquad_format.records.record_check import check_record
from triquad_format.wire.messages import CheckpointInfo

from triquad_server.errors import StoreBaseError, StoreError
from triquad_server.mapping.mapper import MapChanges
from triquad_server.mesh.preview import preview_schema
from triquad_server.settings import StoreSettings
from triquad_server.store.checkpoint_folder import CheckpointFolder
from triquad_server.store.checkpoint_parts import (
    KnownParts,
    StoppedError,
    abortable,
    checkpoint_parts,
    copied_parts,
    known_parts,
    own_bytes,
)
from triquad_server.store.restore import ValidCheckpoint, newest_valid


class Store:
    """The checkpoints of one map, for one thread. One server at a time holds the folder."""

    def __init__(self, root: Path, map_name: str, settings: StoreSettings) -> None:
        """Take possession of ``root/map_name``, which is made if need be.

        Raises:
            StoreError: the folder cannot be written to, or another server holds it.
        """
        self.folder = root / map_name
        self._known: KnownParts | None = None
        try:
            self._files = CheckpointFolder(self.folder, settings)
        except OSError as error:
            raise StoreError(f"store {self.folder} cannot be written to: {error}") from error

    def close(self) -> None:
        """Let go of the folder."""
        self._files.close()

    @property
    def base_epoch(self) -> int | None:
        """The epoch after which changes are enough for a checkpoint; ``None``: all is needed."""
        known = self._known
        if known is None or not self._files.unchanged(known.files):
            return None
        return known.facts.epoch

    def newest(self) -> ValidCheckpoint | None:
        """The newest valid checkpoint, from which the map goes on; ``None``: there is none at all.

        Raises:
            StoreError: see :func:`triquad_server.store.restore.newest_valid`.
        """
        newest = newest_valid(self.folder)
        if newest is not None:
            manifest = newest.file.manifest
            own = FileRef(newest.path.name, newest.file.manifest_sha256)
            stored = {other: self._stored_bytes(other) for other in manifest.files}
            self._known = known_parts(manifest, own, stored)
            self._files.record(self._known.files)
        return newest

    def write(self, changes: MapChanges) -> CheckpointInfo:
        """Write a checkpoint of what changed since :attr:`base_epoch`; delete the oldest.

        Raises:
            StoreBaseError: older files cannot be read; all of the map is needed.
            StoreError: it could not be written; the older ones are untouched.
        """
        record, known = changes.record, self._known
        changed = {region.index for region in record.regions}
        # Where most changed, the rest is copied, too: the checkpoint then needs no other.
        delta = known is not None and known.is_small(changed)
        path = self.folder / checkpoint_name(record.epoch, complete=not delta)
        stamp_ns = stamp_now_ns()
        with self._writing(f"checkpoint {path} cannot be written") as others:
            check_record(record)
            written = write_parts(
                path,
                MapFacts(record.name, record.epoch, record.settings),
                checkpoint_parts(changes, known, None if delta else others, stamp_ns),
                stamp_ns=stamp_ns,
                known={} if known is None else known.entries if delta else known.stored_here(),
                preview_schema=preview_schema(),
            )
            info = _info(path, written)
        self._set_newest(path, written, {} if known is None else known.stored)
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
            with self._writing(f"{path} cannot be folded") as others:
                parts = abortable(stopping, copied_parts(known.entries.values(), others))
                written = write_parts(
                    path,
                    known.facts,
                    parts,
                    stamp_ns=known.stamp_ns,
                    known=known.stored_here(),
                    preview_schema=preview_schema(),
                )
                info = _info(path, written)
        except StoppedError:
            return None
        self._set_newest(path, written, {})
        return info

    @contextmanager
    def _writing(self, failure: str) -> Iterator[OtherFiles]:
        """The older files, while a new one is written; errors begin with ``failure``."""
        try:
            self._files.renew_lock()
            with closing(OtherFiles(files_in(self.folder))) as others:
                yield others
        except MapFileError as error:
            self._known = None
            raise StoreBaseError(f"{failure}: {error}") from error
        except (FormatError, OSError) as error:
            raise StoreError(f"{failure}: {error}") from error
        except MemoryError as error:
            raise StoreError(f"{failure}: out of memory") from error

    def _set_newest(self, path: Path, written: WrittenMap, stored: Mapping[FileRef, int]) -> None:
        """Record what was written; delete the oldest."""
        file = FileRef(path.name, written.manifest_sha256)
        self._known = known_parts(written.manifest, file, stored)
        self._files.record([path.name])
        self._files.delete_old(self._known.facts.epoch)

    def _stored_bytes(self, file: FileRef) -> int:
        """Bytes of the parts in a file, needed or not."""
        checkpoint = checkpoint_file(self.folder / file.name)
        return 0 if checkpoint is None else own_bytes(open_manifest(checkpoint))


def _info(path: Path, written: WrittenMap) -> CheckpointInfo:
    info = written.info
    return CheckpointInfo(
        path=str(path),
        bytes=info.bytes,
        epoch=info.epoch,
        sha256=info.sha256,
        stamp_ns=path.stat().st_mtime_ns,
    )


def stamp_now_ns() -> int:
    """Nanoseconds since 1970; within what a file can hold, whatever the clock says."""
    return min(max(time.time_ns(), 0), 2**63 - 1)
