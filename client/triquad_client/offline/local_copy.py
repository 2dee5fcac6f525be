"""A copy of the part of a server's map that a box needs, in a file and in memory."""

import dataclasses
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from triquad_format.errors import FormatError, MapFileError
from triquad_format.mapfile.parts.part import Part, PartKey
from triquad_format.mapfile.reader import assemble
from triquad_format.mapfile.writer import write_parts
from triquad_format.records.record_check import check_record
from triquad_format.records.region import MapRecord
from triquad_map.stored_map import StoredMap

from triquad_client import checks
from triquad_client.calls.download import newest_file
from triquad_client.calls.remote_bytes import RemoteBytes
from triquad_client.checks import Bounds
from triquad_client.errors import DownloadError
from triquad_client.net.call import Call, ResultT, Run, offload, retried
from triquad_client.offline.local_driver import LocalDriver


@dataclass(frozen=True)
class SyncReport:
    """What it took to bring a copy up to date."""

    epoch: int  # of the copy now
    bytes_received: int  # of the map file, its index included
    parts_received: int
    parts_kept: int  # that were there already

    @property
    def parts(self) -> int:
        """All that the copy holds."""
        return self.parts_received + self.parts_kept


@dataclass(frozen=True)
class _State:
    """What a copy is, as a whole: threads see one or the next."""

    sha256: str  # of the file on the server that it was made from
    driver: LocalDriver
    epoch: int
    checked_s: float  # of the monotonic clock, when the server had nothing newer
    report: SyncReport  # of the last update


class LocalCopy:
    """The copy; for several threads. It is empty until :meth:`_update` has run."""

    def __init__(self, path: Path, bounds: Bounds) -> None:
        """``path`` is the file, ``bounds`` are the corners of the box.

        Raises:
            InvalidInputError: the bounds are not a box, or hold nothing.
        """
        self._path = path
        self._low, self._high = checks.finite_box(bounds)
        self._updating = threading.Lock()
        self._state: _State | None = None

    @property
    def epoch(self) -> int:
        """The server's epoch, a published state of its map, that the copy was made from."""
        return self._current().epoch

    @property
    def age_s(self) -> float:
        """Seconds since the server had nothing newer: how old the copy may be at most."""
        return time.monotonic() - self._current().checked_s

    @property
    def report(self) -> SyncReport:
        """What it took to bring the copy up to date the last time."""
        return self._current().report

    def _answer(self, call: Call[ResultT]) -> ResultT:
        """Answer a call, all of it from one epoch."""
        return self._current().driver.run(call)

    def _update(self) -> Call[SyncReport]:
        """Fetch what changed; where that fails, the copy stays as it was.

        Raises:
            DownloadError: what arrived is not valid.
            OSError: the file cannot be written.
        """
        return retried("chunk_gone", lambda: offload(self._fetch))

    def _current(self) -> _State:
        assert self._state is not None, "_update() comes first"
        return self._state

    def _fetch(self, run: Run) -> SyncReport:
        with self._updating:
            asked_s = time.monotonic()
            info = run(newest_file(training=False))
            known = self._state
            if known is not None and known.sha256 == info.sha256:
                report = SyncReport(
                    epoch=info.epoch,
                    bytes_received=0,
                    parts_received=0,
                    parts_kept=known.report.parts,
                )
                self._state = dataclasses.replace(known, checked_s=asked_s, report=report)
                return report
            remote = RemoteBytes(run, info)
            try:
                parts = _Parts(StoredMap(remote), self._low, self._high)
                parts.reuse(self._path)
                parts.fetch()
                record = parts.record()
                parts.write(self._path)
            except FormatError as error:
                raise DownloadError(str(error)) from error
            received = len(parts.wanted) - parts.kept
            report = SyncReport(
                epoch=info.epoch,
                bytes_received=remote.bytes_read,
                parts_received=received,
                parts_kept=parts.kept,
            )
            driver = LocalDriver(record)
            self._state = _State(
                sha256=info.sha256,
                driver=driver,
                epoch=info.epoch,
                checked_s=asked_s,
                report=report,
            )
            if known is not None:
                known.driver.close()
            return report


class _Parts:
    """The parts of a map on the server that a box needs."""

    def __init__(
        self, stored: StoredMap, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> None:
        self._stored = stored
        self.wanted = stored.parts_in(low, high)
        self._payloads: dict[PartKey, bytes] = {}
        self.kept = 0

    def reuse(self, path: Path) -> None:
        """Take the parts that the file has already; it may be no map file."""
        try:
            with StoredMap.open(path) as older:
                known = {entry.key: entry for entry in older.manifest.entries}
                for entry in self.wanted:
                    there = known.get(entry.key)
                    if there is not None and there.sha256 == entry.sha256:
                        with suppress(MapFileError):
                            self._payloads[entry.key] = older.payload(there)
        except (FormatError, FileNotFoundError):
            pass
        self.kept = len(self._payloads)

    def fetch(self) -> None:
        """Have the server send the others."""
        for entry in self.wanted:
            if entry.key not in self._payloads:
                self._payloads[entry.key] = self._stored.payload(entry)

    def record(self) -> MapRecord:
        """All of it.

        Raises:
            FormatError: the parts do not go together.
        """
        chosen = dataclasses.replace(self._stored.manifest, entries=self.wanted)
        record = assemble(chosen, lambda entry: self._payloads[entry.key])
        check_record(record)
        return record

    def write(self, path: Path) -> None:
        """Replace the file at ``path``, all of it or nothing."""
        manifest = self._stored.manifest
        own = {entry.key: dataclasses.replace(entry, file=None) for entry in self.wanted}
        parts = (Part(entry.key, self._payloads[entry.key]) for entry in self.wanted)
        write_parts(path, manifest.facts, parts, stamp_ns=manifest.stamp_ns or None, known=own)
