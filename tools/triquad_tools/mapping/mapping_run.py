"""Making a map of a recording, scan by scan."""

import time
from collections import Counter

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.intake.scan_warnings import ScanWarnings
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

from triquad_tools.console.progress import progress
from triquad_tools.mapping.unfinished import UnfinishedMap
from triquad_tools.recordings.selection import Selection

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
