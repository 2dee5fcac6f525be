"""Checkpoints on disk: one folder per map.

A checkpoint is a small file that names its parts, and each part is a file that is named by its
digest: docs/reliability.md walks through the folder.
"""

import dataclasses
import hashlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from triquad_format.errors import FormatError
from triquad_format.mapfile.checkpoint_folder import (
    NewParts,
    PartFiles,
    checkpoint_files,
    checkpoint_name,
    checkpoint_of,
)
from triquad_format.mapfile.index import Checkpoint, Restored, read_checkpoint, write_checkpoint
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.record_check import check_record
from triquad_format.mapfile.region_facts import FactsByRegion
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord, Region
from triquad_format.wire.messages import CheckpointInfo
from triquad_map.compiled.team import Split, in_one

from triquad_server.epochs.cold_region import ColdRegion
from triquad_server.errors import StoreError
from triquad_server.settings import StoreSettings
from triquad_server.store.lock import StoreLock
from triquad_server.store.restore import (
    ValidCheckpoint,
    check_countable,
    maps_beside,
    newest_valid,
    valid_checkpoint,
)
from triquad_server.store.retention import delete_unfinished, delete_unneeded
from triquad_server.store.scan_log import ScanLog
from triquad_server.store.stored_regions import StoredRegions, write_regions

_log = logging.getLogger(__name__)


class Store:
    """Manages the checkpoints of one map, for one thread; one server at a time locks the folder."""

    def __init__(
        self,
        root: Path,
        map_name: str,
        settings: StoreSettings,
        cache_bytes: Callable[[], int] = lambda: 0,
        split: Split = in_one,
    ) -> None:
        """Lock ``root/map_name``, which is made if need be; delete unfinished files in it.

        Regions that are read to answer questions take ``cache_bytes()``, and ``split`` shares the
        work of it.

        Raises:
            StoreError: the folder cannot be written to, or another server has locked it.
        """
        self.folder = root / map_name
        self.keep_resets = settings.keep_resets
        self._newest: Manifest | None = None  # from which later ones take what did not change
        self._facts: FactsByRegion | None = {}  # of its regions; None: it tells of none
        self.regions = StoredRegions(self.folder, cache_bytes, split)
        self._is_whole = True  # of the newest; else what is in memory of it is written again
        self.restored: Restored | None = None  # the last time to an older checkpoint
        self._settings = settings
        # That the map takes in, from :meth:`log_scans` on.
        self.scans = ScanLog(self.folder, 0, leaf_m=1.0, epoch=0, restored=None)
        self.last: CheckpointInfo | None = None  # the checkpoint that was read or written last
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = StoreLock(self.folder)
        except OSError as error:
            raise StoreError(
                f"store {self.folder} cannot be written to: {error.strerror or error}; choose "
                "another --store, or let this user write there"
            ) from error
        delete_unfinished(self.folder)

    def log_scans(self, leaf_m: float) -> None:
        """Keep scans, too, from the newest checkpoint on; ``leaf_m`` is the side of a voxel."""
        most = self._settings.log_max_bytes
        self.scans = ScanLog(self.folder, most, leaf_m, self.epoch, self.restored)

    def close(self) -> None:
        """Release the folder."""
        self.scans.close()
        self._lock.close()

    @property
    def epoch(self) -> int:
        """The epoch of the newest checkpoint; 0: there is none."""
        return 0 if self._newest is None else self._newest.facts.epoch

    def versions(self) -> dict[RegionIndex, int]:
        """Return when each region changed last that the newest checkpoint has, as an epoch."""
        versions: dict[RegionIndex, int] = {}
        for entry in () if self._newest is None else self._newest.entries:
            index = entry.key.region
            versions[index] = max(entry.epoch, versions.get(index, 0))
        return versions

    @property
    def base_epoch(self) -> int | None:
        """The epoch after which changes are enough for a checkpoint; ``None``: all is needed.

        That is the newest checkpoint's, as long as its file is as it was written, and its parts are
        there.
        """
        newest, info = self._newest, self.last
        if newest is None or info is None or not self._is_whole:
            return None
        try:
            data = Path(info.path).read_bytes()
        except OSError:
            return None
        unchanged = hashlib.sha256(data).hexdigest() == info.sha256
        has_parts = all(map(PartFiles(self.folder).has, newest.entries))
        return info.epoch if unchanged and has_parts else None

    def newest(self) -> ValidCheckpoint | None:
        """Return the newest valid checkpoint, from which the map goes on; ``None``: there is none.

        Raises:
            StoreError: see :func:`triquad_server.store.restore.newest_valid`.
        """
        newest = newest_valid(self.folder)
        self.last = None if newest is None else newest.info
        if newest is not None and newest.checkpoint is not None:
            self._newest = newest.checkpoint.manifest
            self._facts = newest.regions
            if self._facts is not None:
                self.regions.put(newest.record, self._newest.of_regions(), self._facts)
            self.restored = newest.checkpoint.restored
        return newest

    def write(
        self, record: MapRecord, changed: Iterable[Region], facts: FactsByRegion, undoes: str = ""
    ) -> CheckpointInfo:
        """Write a checkpoint of what changed since :attr:`base_epoch`; delete what need not stay.

        Args:
            record: the map, without regions.
            changed: the regions that changed; each is made when it is written.
            facts: of all regions of the map.
            undoes: what it undoes, such as a reset: it stays for longer. Empty: nothing.

        Raises:
            StoreError: it could not be written; the older ones are untouched.
        """
        path = self.folder / checkpoint_name(record.epoch)
        with self._writing(f"checkpoint {path} cannot be written"):
            check_record(record)
            written = self._parts_of(record, changed)
            manifest = Manifest(record.facts, 0, self._entries(facts, written))
            info = self._write(manifest, facts, undoes)
            self.regions.put(record, written, facts, only=facts)
            return info

    def put(self, record: MapRecord, changed: Iterable[Region], facts: FactsByRegion) -> None:
        """Write regions that are to leave memory; the next checkpoint names them.

        Arguments and errors are those of :meth:`write`.
        """
        with self._writing(f"regions in {self.folder} cannot be written"):
            self.regions.put(record, self._parts_of(record, changed), facts)

    def adopt(self, region: ColdRegion, other: StoredRegions) -> ColdRegion:
        """Copy a region from the store of another server; the next checkpoint names it.

        Raises:
            StoreError: it cannot be read there, or not written here.
        """
        with self._writing(f"region {region.index} of {other.folder} cannot be taken"):
            try:
                self._copy(region, other)
            except FormatError as error:
                if not other.take_older(region):
                    remedy = "restore that folder from a backup, or move it away"
                    raise FormatError(f"{error}; {remedy}") from error
                self._copy(region, other)
            return self.regions.adopt(region, other.facts)

    def _copy(self, region: ColdRegion, other: StoredRegions) -> None:
        new = NewParts(self.folder, region.epoch)
        for entry in region.entries:
            new.copy(entry, other.folder)
        new.commit()

    def keep_newest(self, undoes: str) -> CheckpointInfo | None:
        """Let the newest checkpoint stay for longer, as one that ``undoes`` something.

        ``None``: it is not there, or not whole.

        Raises:
            StoreError: that could not be written; it stays as any other.
        """
        newest = self._newest
        if newest is None or self.base_epoch is None:
            return None
        with self._writing(f"epoch {newest.facts.epoch} cannot be kept"):
            return self._write(newest, self._facts, undoes)

    def forget_base(self, name: str) -> bool:
        """Write what is in memory next time, if the newest checkpoint needs the file ``name``.

        A region that is not in memory is taken from an older checkpoint.
        """
        newest = self._newest
        if newest is None:
            return False
        names = {entry.name for entry in newest.entries}
        if name not in names | {checkpoint_name(newest.facts.epoch)}:
            return False
        self._is_whole = False
        self.regions.mend(name)
        return True

    def restore(self, epoch: int) -> None:
        """Restore the map to an older checkpoint, which is written again as the newest.

        What was the newest so far stays as one that undoes something. A server that is started
        again with the same ``epoch`` keeps what was learnt since: to restore it there once more
        changes nothing.

        Raises:
            StoreError: there is no such checkpoint, it is not valid, or it cannot be written again.
        """
        hint = partial(maps_beside, self.folder)
        with self._writing(f"epoch {epoch} cannot be restored", hint):
            files = checkpoint_files(self.folder)
            newest = _readable(files[0].path) if files else None
            done = None if newest is None else newest.restored
            if done is not None and done.epoch == epoch:
                _log.warning(
                    "the map was taken back to epoch %d before, as epoch %d, and goes on from its "
                    "newest checkpoint; to go back there again, use --restore %d",
                    *(epoch, done.as_epoch, done.as_epoch),
                )
                return
            chosen = checkpoint_of(self.folder, epoch)
            if chosen.epoch == files[0].epoch:
                return
            check_countable(files[0].path, files[0].epoch + 1)
            found = valid_checkpoint(chosen)
            again = self._manifest_again(found, files[0].epoch + 1)
            if newest is not None:
                marked = dataclasses.replace(newest, undoes=f"restoring epoch {epoch}")
                write_checkpoint(files[0].path, marked)
            self.restored = Restored(epoch, again.facts.epoch)
            self._write(again, found.regions)
        _log.warning(
            "the map is that of epoch %d again, as epoch %d; what it was is kept as epoch %d",
            *(epoch, again.facts.epoch, files[0].epoch),
        )

    def _manifest_again(self, found: ValidCheckpoint, epoch: int) -> Manifest:
        """Return the list of a checkpoint's parts, all in the store, under another epoch."""
        manifest, regions = found.manifest, found.record.regions
        if found.checkpoint is None:  # a map file: its parts are not in the store
            written = self._parts_of(found.record, regions)
            manifest = dataclasses.replace(manifest, entries=self._entries(written, written))
        return dataclasses.replace(manifest, facts=dataclasses.replace(manifest.facts, epoch=epoch))

    def _parts_of(
        self, record: MapRecord, regions: Iterable[Region]
    ) -> dict[RegionIndex, list[Entry]]:
        """Write those parts of regions that are not there yet; return all of each."""
        newest = self._newest if self._is_whole else None  # else what is there is looked at
        before = {} if newest is None else newest.of_regions()
        return write_regions(self.folder, record, regions, before)

    def _entries(
        self, indices: Iterable[RegionIndex], written: Mapping[RegionIndex, Sequence[Entry]]
    ) -> tuple[Entry, ...]:
        """Return the parts of regions: those that were written, else those that are there."""
        newest = {} if self._newest is None else self._newest.of_regions()
        known = {index: region.entries for index, region in self.regions.known.items()}
        parts = {**newest, **known, **written}
        return tuple(entry for index in indices for entry in parts[index])

    def _write(
        self,
        manifest: Manifest,
        facts: FactsByRegion | None,
        undoes: str = "",
    ) -> CheckpointInfo:
        """Write the file that makes parts a checkpoint; then delete what need not stay."""
        path = self.folder / checkpoint_name(manifest.facts.epoch)
        manifest = dataclasses.replace(manifest, stamp_ns=stamp_now_ns())
        file = write_checkpoint(path, Checkpoint(manifest, undoes, self.restored, facts))
        info = CheckpointInfo(
            path=str(path),
            bytes=file.bytes + manifest.stored_bytes,
            epoch=file.epoch,
            sha256=file.sha256,
            stamp_ns=manifest.stamp_ns,
        )
        self._newest, self._facts, self._is_whole = manifest, facts, True
        self.last = info
        self.tidy(info.epoch)
        return info

    def tidy(self, newest: int | None = None) -> None:
        """Delete parts that nothing needs, and older checkpoints than ``newest``, if it is given.

        How many of these stay, the settings say.
        """
        delete_unneeded(self.folder, self._settings, newest, also_needed=self.regions.part_names)

    @contextmanager
    def _writing(self, failure: str, hint: Callable[[], str] = lambda: "") -> Iterator[None]:
        """Write to the folder; what a failure leaves is deleted, and its error is named.

        Raises:
            StoreError: it failed; the text begins with ``failure`` and ends with the hint.
        """
        try:
            self._lock.renew()
            yield
        except (FormatError, OSError) as error:
            self.tidy()
            raise StoreError(f"{failure}: {error}{hint()}") from error


def _readable(path: Path) -> Checkpoint | None:
    """Return a checkpoint; ``None`` where it is a map file, or damaged."""
    with suppress(FormatError):
        return read_checkpoint(path)
    return None


def stamp_now_ns() -> int:
    """Return nanoseconds since 1970, within what a file can hold, whatever the clock says."""
    return min(max(time.time_ns(), 0), 2**63 - 1)
