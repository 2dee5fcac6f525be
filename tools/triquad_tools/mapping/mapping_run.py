"""Making a map of a recording, scan by scan, and going on with one that was interrupted."""

import hashlib
import os
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from triquad_format.errors import FormatError
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_format.wire.messages import Scan
from triquad_server.errors import ScanRefusedError, StoreError
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.mapping.output import why
from triquad_tools.recordings.opening import Selection
from triquad_tools.recordings.recording import ScanEntry

MAP_NAME = "recording"
OUTSIDE = "outside_world"  # the reason for which scans are refused that are too far away
_SAVE_PERIOD_S, _SAVE_SHARE = 60.0, 0.05  # at least, and of the time: a large map takes seconds
SECTIONS = {"field", "scan", "change", "training", "sources"}  # that a map depends on
_KEY_DIGITS = 40  # the name of a map has 64 characters at most, and the number of scans follows


def mapping_key(selection: Selection, settings: Settings) -> str:
    """Return a key that identifies the scans and settings; it can be the name of a map."""
    digest = hashlib.sha256(settings.model_dump_json(include=SECTIONS).encode())
    digest.update(selection.way.encode())
    for entry in selection.entries:
        digest.update(f"{entry.stamp_ns} {entry.source}\n".encode())
    return digest.hexdigest()[:_KEY_DIGITS]


def another_frame(refusal: str, scan: ScanEntry, first: ScanEntry) -> ToolError:
    """Return the error for a second scan in a row that is out of the world."""
    after_s = (scan.stamp_ns - first.stamp_ns) / 1e9
    return ToolError(
        f"{refusal}; this one is {after_s:.3f} s after the first: map what is before by --end, or "
        "what is after by --start"
    )


@dataclass(frozen=True)
class UnfinishedMap:
    """What an earlier run has saved."""

    record: MapRecord | None = None
    scans_taken: int = 0  # or refused: those that need not be taken again


def read_unfinished(path: Path, key: str) -> UnfinishedMap:
    """Return what a run left in a file that did not finish; nothing where there is none.

    Raises:
        ToolError: it is of another recording or other settings, or is not ours.
    """
    if not os.path.lexists(path):
        return UnfinishedMap()
    try:
        record = read_map(path)
    except (FormatError, OSError) as error:
        raise ToolError(
            f"{path} holds something else; move it away, or give OUT another name ({error})"
        ) from error
    own_key, _, scans_taken = record.name.partition(".")
    if own_key != key or not scans_taken.isdecimal():
        raise ToolError(
            f"{path} holds an unfinished map of another recording, or with other flags or "
            "settings: give the same to go on with it, or delete it to begin again"
        )
    return UnfinishedMap(replace(record, name=MAP_NAME), int(scans_taken))


@dataclass
class MappingRun:
    """Integrates the scans of a recording and trains on them.

    What is done is saved each minute, from where an interrupted map goes on: in a map file whose
    map has the key for a name, and the number of scans that are in it.
    """

    mapper: Mapper
    settings: Settings
    unfinished: Path
    key: str
    scans_taken: int  # or refused

    def __post_init__(self) -> None:
        self._warnings = ScanWarnings(ScanQueue(1), self.settings)
        self._next_save_s = time.monotonic() + _SAVE_PERIOD_S
        self.refusals: Counter[str] = Counter()
        self._outside = False  # the last scan was too far from the map's origin
        self.last_refusal = ""

    def take(self, selection: Selection) -> None:
        """Integrate the scans that are left, and train between them.

        Raises:
            ToolError: the poses go on in another frame: two scans in a row are out of the world.
        """
        total, entries = len(selection), selection.entries
        with progress("mapping", total) as report:
            for scan in selection.scans(self.scans_taken):
                self._save_now_and_then()
                entry = entries[self.scans_taken]
                try:
                    stamp_ns, source = entry.stamp_ns, entry.source
                    points, pose = np.asarray(scan.points, np.float32), scan.world_from_sensor
                    rays = self.mapper.ingest(
                        points, pose, stamp_ns // 10**9, source=source, no_return=scan.no_return
                    )
                    self._warnings.add(Scan(points, pose, stamp_ns, source, 0, 0), rays)
                    self._warnings.check()
                    self._outside = False
                except ScanRefusedError as error:
                    self.refusals[error.reason] += 1
                    self.last_refusal = f"scan {self.scans_taken}: {error}"
                    was_outside, self._outside = self._outside, error.reason == OUTSIDE
                    if self._outside and was_outside:
                        raise another_frame(self.last_refusal, entry, entries[0]) from error
                self.scans_taken += 1
                self.mapper.train()
                report(self.scans_taken, f"{self.scans_taken} of {total} scans")

    def settle(self, limit_s: float | None) -> None:
        """Save the map, train until nothing is left to learn or the time is up, save it again."""
        self._save()
        mapper = self.mapper
        total, ends_s = mapper.samples_left, time.monotonic() + (limit_s or 0.0)
        with progress("training", total) as report:
            while not mapper.settled and (limit_s is None or time.monotonic() < ends_s):
                self._save_now_and_then()
                mapper.train()
                left = mapper.samples_left
                report(total - left, f"{mapper.samples_trained / 1e6:.1f} M samples")
        self._save()

    def _save_now_and_then(self) -> None:
        if time.monotonic() >= self._next_save_s:
            self._save()

    def _save(self) -> None:
        """Write the map; where it cannot be written, what was saved before is untouched."""
        started_s = time.monotonic()
        record = self.mapper.snapshot_since(None).record()
        try:
            write_map(replace(record, name=f"{self.key}.{self.scans_taken}"), self.unfinished)
        except OSError as error:
            raise StoreError(
                f"{self.unfinished} cannot be written: {why(error)}; with room for it the "
                "same command goes on where the map was saved last"
            ) from error
        ended_s = time.monotonic()
        self._next_save_s = ended_s + max(_SAVE_PERIOD_S, (ended_s - started_s) / _SAVE_SHARE)
