"""A map that is not finished: its checkpoints, and how far in the recording each of them is."""

import hashlib
import json
import shutil
from contextlib import suppress
from pathlib import Path

from triquad_format.mapfile.files import replacing
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings, StoreSettings
from triquad_server.store.store import Store

from triquad_tools.console.command import ToolError
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
