"""Making a map of a recording, scan by scan."""

import hashlib
import json
import shutil
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from triquad_format.mapfile.durable_file import replacing
from triquad_server.errors import ScanRefusedError
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings, StoreSettings
from triquad_server.store.store import Store

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.selection import Selection

MAP_NAME = "recording"
_POSITIONS = "positions.json"
_SECTIONS = {"field", "scan", "change", "training", "sources"}  # that a map depends on
_KEEP = StoreSettings(period_s=0.0, keep=2)


def mapping_key(selection: Selection, settings: Settings) -> str:
    """Return a key that identifies the scans, poses and settings of an unfinished map."""
    digest = hashlib.sha256(settings.model_dump_json(include=_SECTIONS).encode())
    digest.update(selection.way.encode())
    for entry in selection.entries:
        digest.update(f"{entry.stamp_ns} {entry.source}\n".encode())
    return digest.hexdigest()


class UnfinishedMap:
    """The folder next to the output that holds a map while it is made. Close it."""

    def __init__(self, output: Path, key: str) -> None:
        """Lock the folder, which is made if need be.

        Raises:
            ToolError: it holds a map of another recording or other settings, or is not ours.
            StoreError: it cannot be written to, or another process makes a map in it.
        """
        self.folder = output.with_name(f"{output.name}.part")
        self._key = key
        self._positions = self.folder / _POSITIONS
        self._check_ours()
        self._store = Store(self.folder, MAP_NAME, _KEEP)
        self.scans_taken = 0
        self._taken_by: dict[str, int] = {}  # scans by epoch
        try:
            if self._positions.exists():
                self._read_positions()
            else:
                self._write_positions()
        except BaseException:
            self._store.close()
            raise

    def close(self) -> None:
        """Unlock the folder; what is in it stays, unless nothing was saved yet."""
        self._store.close()
        if not self._taken_by:
            self.remove()

    def remove(self) -> None:
        """Delete the folder, once it is closed: the map is finished."""
        shutil.rmtree(self.folder / MAP_NAME)
        self._positions.unlink()
        with suppress(OSError):  # other files in the folder are kept
            self.folder.rmdir()

    def resumed(self, settings: Settings, device: str, teams: Teams) -> Mapper:
        """Return a mapper that goes on with the map, which has taken :attr:`scans_taken` scans.

        Raises:
            StoreError: there are checkpoints, but none can be read.
        """
        newest = self._store.newest()
        if newest is not None:
            epoch = str(newest.record.epoch)
            if epoch not in self._taken_by:
                raise ToolError(
                    f"{self.folder}: {_POSITIONS} says nothing of epoch {epoch}; delete the folder "
                    "to begin again"
                )
            self.scans_taken = self._taken_by[epoch]
        record = None if newest is None else newest.record
        mapper = Mapper(MAP_NAME, settings, device, record=record, teams=teams)
        # What comes from now on is of a later epoch than the checkpoint.
        mapper.publish()
        return mapper

    def save(self, mapper: Mapper, scans_taken: int) -> None:
        """Write a checkpoint from which the map can go on.

        Raises:
            StoreError: it cannot be written; the one before is untouched.
        """
        known = self._store.base_epoch
        changes = mapper.changes_since(known)
        # First: a checkpoint without its position would be of no use.
        self._taken_by[str(changes.record.epoch)] = scans_taken
        self._write_positions()
        if changes.record.epoch != known:
            self._store.write(changes)

    def _check_ours(self) -> None:
        """Refuse to write to, and later to delete, files that are not ours."""
        if self.folder.is_symlink():
            raise ToolError(f"{self.folder} is a link; remove it, or give OUT another name")
        if self.folder.is_dir() and any(self.folder.iterdir()) and not self._positions.is_file():
            raise ToolError(
                f"{self.folder} holds something else; move it away, or give OUT another name"
            )

    def _write_positions(self) -> None:
        text = json.dumps({"key": self._key, "scans_taken": self._taken_by})
        with replacing(self._positions) as stream:
            stream.write(text.encode())

    def _read_positions(self) -> None:
        path = self._positions
        try:
            read = json.loads(path.read_text())
            key, self._taken_by = read["key"], dict(read["scans_taken"])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ToolError(f"{path} is damaged; delete {self.folder} to begin again") from error
        if key != self._key:
            raise ToolError(
                f"{self.folder} holds an unfinished map of another recording, or with other "
                "flags or settings: give the same to go on with it, or delete it to begin again"
            )


_SAVE_PERIOD_S = 60.0


class MappingRun:
    """Integrates the scans of a recording and trains until nothing is left to learn.

    What is done is saved each minute, from where an interrupted map goes on.
    """

    def __init__(self, mapper: Mapper, unfinished: UnfinishedMap, settings: Settings) -> None:
        self._mapper = mapper
        self._unfinished = unfinished
        self._warnings = ScanWarnings(ScanQueue(1), settings)
        self._next_save = time.monotonic() + _SAVE_PERIOD_S
        self.scans_taken = 0  # or refused: those that need not be taken again
        self.refusals: Counter[str] = Counter()
        self.last_refusal = ""

    def take(self, selection: Selection, start: int) -> None:
        """Integrate the scans from number ``start`` on, and train between them."""
        self.scans_taken = start
        total, entries = len(selection), selection.entries
        with progress("mapping", total) as report:
            for scan in selection.scans(start):
                self._save_now_and_then()
                entry = entries[self.scans_taken]
                try:
                    stamp_s = entry.stamp_ns // 1_000_000_000
                    pose, source = scan.world_from_sensor, entry.source
                    rays = self._mapper.ingest(scan.points, pose, stamp_s, source=source)
                    self._warnings.add(source, len(scan.points), rays)
                    self._warnings.check()
                except ScanRefusedError as error:
                    self.refusals[error.reason] += 1
                    self.last_refusal = f"scan {self.scans_taken}: {error}"
                self.scans_taken += 1
                self._mapper.train()
                report(self.scans_taken, f"{self.scans_taken} of {total} scans")

    def settle(self) -> None:
        """Save the map, train until nothing is left to learn, and save it again."""
        self._save()
        mapper = self._mapper
        total = mapper.samples_left
        with progress("training", total) as report:
            while not mapper.settled:
                self._save_now_and_then()
                mapper.train()
                left = mapper.samples_left
                report(total - left, f"{mapper.samples_trained / 1e6:.1f} M samples")
        self._save()

    def _save_now_and_then(self) -> None:
        if time.monotonic() >= self._next_save:
            self._save()

    def _save(self) -> None:
        self._unfinished.save(self._mapper, self.scans_taken)
        self._next_save = time.monotonic() + _SAVE_PERIOD_S
