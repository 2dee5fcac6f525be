"""Checkpoints on disk: one folder per map.

A checkpoint holds what changed since the one before and refers to older files for the rest; now
and then all is folded into one file. The settings decide how far back they reach.
"""

import dataclasses
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

from triquad_format.errors import FormatError, MapFileError
from triquad_format.mapfile.checkpoint_folder import (
    checkpoint_file,
    checkpoint_files,
    checkpoint_name,
    checkpoint_of,
    open_manifest,
)
from triquad_format.mapfile.index import OtherFiles, files_in
from triquad_format.mapfile.manifest import Entry
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.parts.pack import pack_region
from triquad_format.mapfile.parts.part import MAP, Part
from triquad_format.mapfile.protections import Restored
from triquad_format.mapfile.writer import WrittenMap, write_parts
from triquad_format.records.record_check import check_record
from triquad_format.wire.messages import CheckpointInfo
from triquad_map.preview import preview_part, preview_schema

from triquad_server.errors import StoreBaseError, StoreError
from triquad_server.mapping.map_snapshot import MapChanges
from triquad_server.settings import StoreSettings
from triquad_server.store.kept_checkpoints import KeptCheckpoints
from triquad_server.store.known_parts import KnownParts, own_bytes
from triquad_server.store.restore import (
    ValidCheckpoint,
    check_countable,
    newest_valid,
    valid_checkpoint,
)

_log = logging.getLogger(__name__)

_FEATURE_DTYPE = "<f2"
_MANY_BYTES = 2**62
"""The size of a file that does not open: what is needed of it is soon folded into another."""
_MAPS_NAMED = 8  # maps of a store that are named where an epoch is not found


class Store:
    """Manages the checkpoints of one map, for one thread; one server at a time locks the folder."""

    def __init__(self, root: Path, map_name: str, settings: StoreSettings) -> None:
        """Lock ``root/map_name``, which is made if need be.

        Raises:
            StoreError: the folder cannot be written to, or another server has locked it.
        """
        self.folder = root / map_name
        self._known: KnownParts | None = None
        try:
            self._files = KeptCheckpoints(self.folder, settings)
        except OSError as error:
            raise StoreError(
                f"store {self.folder} cannot be written to: {error.strerror or error}; choose "
                "another --store, or let this user write there"
            ) from error

    def close(self) -> None:
        """Release the folder."""
        self._files.close()

    @property
    def base_epoch(self) -> int | None:
        """The epoch after which changes are enough for a checkpoint; ``None``: all is needed."""
        known = self._known
        if known is None or not self._files.unchanged(known.files):
            return None
        return known.facts.epoch

    def newest(self) -> ValidCheckpoint | None:
        """Return the newest valid checkpoint, from which the map goes on; ``None``: there is none.

        Raises:
            StoreError: see :func:`triquad_server.store.restore.newest_valid`.
        """
        newest = newest_valid(self.folder)
        if newest is not None:
            self._known = self._known_of(newest)
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
                MapFacts.of(record),
                _changed_parts(changes, known, None if delta else others, stamp_ns=stamp_ns),
                stamp_ns=stamp_ns,
                known={} if known is None else known.entries if delta else known.stored_here(),
                preview_schema=preview_schema(),
            )
            info = _info(path, written)
        self._set_newest(path, written, {} if known is None else known.stored)
        return info

    def forget_base(self, name: str) -> bool:
        """Write all of the map next time, if the newest checkpoint needs the file ``name``."""
        if self._known is None or name not in self._known.files:
            return False
        self._known = None
        return True

    def fold(self, stopping: Callable[[], bool]) -> CheckpointInfo | None:
        """Fold the newest checkpoint into one file if that pays; return what was written.

        It is aborted as soon as ``stopping()`` returns true.

        Raises:
            StoreBaseError: a file that holds parts cannot be read; all of the map is needed.
            StoreError: the file cannot be written.
        """
        known = self._known
        if known is None or not known.worth_folding:
            return None
        try:
            return self._write_whole(known, "folded", stopping)
        except _StoppedError:
            return None

    def protect(self, epoch: int, why: str, instead_of: int | None = None) -> None:
        """Have a checkpoint stay for ``protect_h``, whatever else retention says.

        ``instead_of`` is another that need not stay any more.

        Raises:
            StoreError: too much is protected already, or this cannot be recorded.
        """
        try:
            self._files.protect(epoch, why, instead_of)
        except OSError as error:
            raise StoreError(f"epoch {epoch} in {self.folder} cannot be kept: {error}") from error

    def restore(self, epoch: int) -> None:
        """Restore the map to an older checkpoint, which is written again as the newest.

        What was the newest so far stays for ``protect_h``, as does the one that is written. A
        server that is started again with the same ``epoch`` keeps what was learnt since:
        to restore it there once more changes nothing.

        Raises:
            StoreError: there is no such checkpoint, it is not valid, or it cannot be written again.
        """
        done = self._files.restored
        if done is not None and done.epoch == epoch:
            _log.warning(
                "the map was taken back to epoch %d before, as epoch %d, and goes on from its "
                "newest checkpoint; to go back there again, use --restore %d",
                *(epoch, done.as_epoch, done.as_epoch),
            )
            return
        try:
            newest = checkpoint_files(self.folder)[:1]
            checkpoint = checkpoint_of(self.folder, epoch)
            if checkpoint.epoch == newest[0].epoch:
                return
            number = newest[0].epoch + 1
            check_countable(newest[0].path, number)
            known = self._known_of(valid_checkpoint(checkpoint))
            self._files.protect(newest[0].epoch, f"before epoch {epoch} was restored")
            facts = dataclasses.replace(known.facts, epoch=number)
            anew = dataclasses.replace(known, facts=facts, stamp_ns=stamp_now_ns())
            self._write_whole(anew, "restored", stopping=lambda: False)
            self._files.protect_restored(Restored(epoch, number), f"epoch {epoch}, restored")
        except (MapFileError, OSError) as error:
            raise StoreError(
                f"epoch {epoch} cannot be restored: {error}{self._maps_beside()}"
            ) from error
        _log.warning(
            "the map is that of epoch %d again, as epoch %d; what it was is kept as epoch %d",
            *(epoch, number, newest[0].epoch),
        )

    def _maps_beside(self) -> str:
        """Return which other maps of the store have checkpoints, where this one has none."""
        try:
            if checkpoint_files(self.folder):
                return ""
            folders = sorted(path for path in self.folder.parent.iterdir() if path.is_dir())
            names = [path.name for path in folders if checkpoint_files(path)]
        except OSError:
            return ""
        listed = ", ".join(names[:_MAPS_NAMED]) + (", ..." if len(names) > _MAPS_NAMED else "")
        return f"; the store has checkpoints of {listed}: name the map by --map" if names else ""

    def _write_whole(
        self, known: KnownParts, verb: str, stopping: Callable[[], bool]
    ) -> CheckpointInfo:
        """Write known parts into one file, as the newest checkpoint.

        Raises:
            _StoppedError: ``stopping()`` returned true.
            StoreError: as of :meth:`fold`.
        """
        path = self.folder / checkpoint_name(known.facts.epoch, complete=True)
        with self._writing(f"{path} cannot be {verb}") as others:
            parts = _abortable(stopping, _copied_parts(known.entries.values(), others))
            written = write_parts(
                path,
                known.facts,
                parts,
                stamp_ns=known.stamp_ns,
                known=known.stored_here(),
                preview_schema=preview_schema(),
            )
            info = _info(path, written)
        self._set_newest(path, written, {})
        return info

    @contextmanager
    def _writing(self, failure: str) -> Iterator[OtherFiles]:
        """Yield the older files, while a new one is written; errors begin with ``failure``."""
        try:
            self._files.renew_lock()
            with closing(OtherFiles(files_in(self.folder))) as others:
                yield others
        except MapFileError as error:
            self._known = None
            raise StoreBaseError(f"{failure}: {error}") from error
        except (FormatError, OSError) as error:
            raise StoreError(f"{failure}: {error}") from error

    def _set_newest(self, path: Path, written: WrittenMap, stored: Mapping[str, int]) -> None:
        """Record what was written; delete the oldest."""
        self._known = KnownParts.after(written.manifest, path.name, stored)
        self._files.add(path, self._known.files)
        self._files.delete_old(self._known.facts.epoch)

    def _known_of(self, checkpoint: ValidCheckpoint) -> KnownParts:
        manifest = checkpoint.file.manifest
        stored = {other: self._stored_bytes(other) for other in manifest.files}
        return KnownParts.after(manifest, checkpoint.path.name, stored)

    def _stored_bytes(self, name: str) -> int:
        """Return the bytes of the parts in a file, needed or not."""
        checkpoint = checkpoint_file(self.folder / name)
        try:
            return 0 if checkpoint is None else own_bytes(open_manifest(checkpoint))
        except MapFileError as error:
            _log.warning("what is needed of %s is intact, but not all: %s", name, error)
            return _MANY_BYTES


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
    """Return nanoseconds since 1970, within what a file can hold, whatever the clock says."""
    return min(max(time.time_ns(), 0), 2**63 - 1)


class _StoppedError(Exception):
    """An error that ends the writing of parts, since something is more urgent."""


def _changed_parts(
    changes: MapChanges, known: KnownParts | None, others: OtherFiles | None, *, stamp_ns: int
) -> Iterator[Part | Entry]:
    """Yield the parts of a checkpoint; unchanged ones are copied from ``others``, if given."""
    changed = {region.index: region for region in changes.record.regions}
    settings = changes.record.settings
    for index in changes.regions:
        region = changed.get(index)
        if region is not None:
            yield from pack_region(region, settings, _FEATURE_DTYPE)
            yield preview_part(region, settings, changes.epoch, stamp_ns=stamp_ns)
        elif known is not None:
            entries = known.of_region(index)
            yield from entries if others is None else _copied_parts(entries, others)


def _copied_parts(entries: Iterable[Entry], others: OtherFiles) -> Iterator[Part]:
    """Yield parts that other files hold, read and checked; the map's own part is made again.

    Raises:
        MapFileError: one of the files cannot be read, or is damaged.
    """
    for entry in entries:
        if entry.key.topic == MAP:
            continue
        try:
            payload = others.payload(entry)
        except OSError as error:  # error of reading: the file that is written is another
            raise MapFileError(f"a file that holds parts cannot be read: {error}") from error
        yield Part(entry.key, payload)


def _abortable(stopping: Callable[[], bool], parts: Iterator[Part]) -> Iterator[Part]:
    """Yield the parts, until ``stopping()``.

    Raises:
        _StoppedError: it returned true.
    """
    for part in parts:
        if stopping():
            raise _StoppedError
        yield part
