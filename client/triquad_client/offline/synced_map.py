"""A copy of the part of a server's map that a box needs: it answers also while the link is down."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_format.errors import FormatError, MapFileError
from triquad_format.mapfile.manifest import Entry, Manifest
from triquad_format.mapfile.parts.part import EVIDENCE, Part, PartKey
from triquad_format.mapfile.reader import StoredMap, assemble
from triquad_format.mapfile.writer import write_parts
from triquad_format.wire.messages import MapInfo

from triquad_client import checks
from triquad_client.calls.download import RemoteBytes, map_target, newest_file
from triquad_client.calls.queries import MapQueries
from triquad_client.checks import Bounds
from triquad_client.errors import DownloadError, EmptierMapError, brief_errors
from triquad_client.net.connection import Connection, retried
from triquad_client.offline.offline_map import LocalMap

_EMPTIER_SHARE = 0.5
"""A map that knows less than this of what the copy knows was lost. A server that goes on from its
last checkpoint knows nearly as much."""


@dataclass(frozen=True)
class SyncReport:
    """The cost of bringing a copy up to date."""

    epoch: int  # of the copy now
    bytes_received: int  # of the map file, its index included
    parts_received: int
    parts_kept: int  # that were there already

    @property
    def parts(self) -> int:
        """All that the copy contains."""
        return self.parts_received + self.parts_kept


@dataclass(frozen=True)
class _State:
    """The state of a copy, as a whole: threads see one or the next."""

    sha256: str  # of the file on the server that it was made from
    map: LocalMap
    checked_s: float  # of the monotonic clock, when the server had nothing newer
    report: SyncReport  # of the last update
    server: str  # the run of the server that it was made from
    seen_bytes: int  # see :func:`_seen_bytes`


@brief_errors
class SyncedMap(MapQueries):
    """The part of a map that a box needs, copied to this machine; several threads may ask it.

    Queries are answered from the copy: what it does not have is unknown. Each is answered from one
    epoch, and ``at_epoch`` may be none but :attr:`epoch`.
    """

    def __init__(self, path: str | Path, bounds: Bounds, connection: Connection) -> None:
        """Use ``Client.sync``."""
        self._path = map_target(path)
        self._connection = connection
        self._low, self._high = checks.finite_box(bounds)
        self._updating = threading.Lock()
        self._state: _State | None = None

    def __repr__(self) -> str:
        return f"SyncedMap({self._path}, {self.age_s:.1f} s old; epoch {self.epoch})"

    @property
    def epoch(self) -> int:
        """The server's epoch, a published state of its map, that the copy was made from."""
        return self._current().report.epoch

    @property
    def age_s(self) -> float:
        """Seconds since the server had nothing newer: how old the copy may be at most."""
        return time.monotonic() - self._current().checked_s

    @property
    def report(self) -> SyncReport:
        """The cost of bringing the copy up to date the last time."""
        return self._current().report

    def refresh(self, accept_emptier: bool = False) -> SyncReport:
        """Fetch what changed on the server. Where that fails, the copy stays as it was.

        Args:
            accept_emptier: take the map also where the server was started again and knows less than
                half of what the copy does.

        Raises:
            TriquadError: the server cannot be reached, as for any call of :class:`Client`.
            InvalidInputError: something else than a map has taken the place of the file.
            EmptierMapError: the server has lost its map, and ``accept_emptier`` is not set.
            DownloadError: what arrived is not valid.
            OSError: the file cannot be written.
        """
        return retried("chunk_gone", lambda: self._fetch(accept_emptier))

    def _current(self) -> _State:
        assert self._state is not None, "refresh() comes first"
        return self._state

    def _fetch(self, accept_emptier: bool) -> SyncReport:
        with self._updating:
            map_target(self._path)
            asked_s = time.monotonic()
            info = newest_file(self._connection)
            known = self._state
            if known is not None and known.sha256 == info.sha256:
                report = SyncReport(info.epoch, 0, 0, parts_kept=known.report.parts)
                self._state = dataclasses.replace(
                    known, checked_s=asked_s, report=report, server=info.server
                )
                return report
            remote = RemoteBytes(self._connection, info)
            try:
                stored = StoredMap(remote)
                wanted = self._wanted(stored)
                if not accept_emptier:
                    self._refuse_emptier(info, _seen_bytes(wanted))
                kept = _kept(self._path, wanted)
                payloads = kept | {
                    entry.key: stored.payload(entry) for entry in wanted if entry.key not in kept
                }
                manifest = dataclasses.replace(stored.manifest, entries=wanted)
                record = assemble(manifest, lambda entry: payloads[entry.key])
                _write(self._path, manifest, payloads)
            except FormatError as error:
                raise DownloadError(str(error)) from error
            report = SyncReport(
                epoch=info.epoch,
                bytes_received=remote.bytes_read,
                parts_received=len(wanted) - len(kept),
                parts_kept=len(kept),
            )
            self._state = _State(
                info.sha256,
                LocalMap(record, local=self._connection.local),
                checked_s=asked_s,
                report=report,
                server=info.server,
                seen_bytes=_seen_bytes(wanted),
            )
            self._server = self._state.map
            if known is not None:
                known.map.view.close()  # questions that are under way go on without its threads
            return report

    def _refuse_emptier(self, info: MapInfo, seen_bytes: int) -> None:
        """Raise where a server that was started again has lost what the copy has.

        The run that the copy was made from may forget as it likes: somebody has asked it to. It is
        not known of which run a file is that was there before.

        Raises:
            EmptierMapError: it has.
        """
        known = self._state
        if known is not None and known.server == info.server != "":
            return
        had_bytes = self._seen_before() if known is None else known.seen_bytes
        if seen_bytes < _EMPTIER_SHARE * had_bytes:
            raise EmptierMapError(
                f"the server may have lost its map: it was started again, and what epoch "
                f"{info.epoch} knows of the box takes {seen_bytes:,} bytes, that of the copy in "
                f"{self._path} {had_bytes:,}. The copy stays as it is, and triquad_client.open_map "
                "opens it; to take the emptier map, pass accept_emptier=True to sync or refresh"
            )

    def _seen_before(self) -> int:
        """Return what the file that is there knows of the box; it may be damaged."""
        with suppress(FormatError, FileNotFoundError), StoredMap.open(self._path) as older:
            return _seen_bytes(self._wanted(older))
        return 0

    def _wanted(self, stored: StoredMap) -> tuple[Entry, ...]:
        """Return the parts of a map that the box needs."""
        zero = self._connection.local * np.array(stored.manifest.facts.origin_m)
        return stored.parts_in(self._low + zero, self._high + zero)


def _seen_bytes(parts: Iterable[Entry]) -> int:
    """Return the bytes of what rays have shown: a measure of how much of the world a map knows."""
    return sum(part.size for part in parts if part.key.topic == EVIDENCE)


def _kept(path: Path, wanted: Sequence[Entry]) -> dict[PartKey, bytes]:
    """Return the wanted parts that a file has already; it may be damaged, or not be there."""
    kept: dict[PartKey, bytes] = {}
    with suppress(FormatError, FileNotFoundError), StoredMap.open(path) as older:
        known = {entry.key: entry for entry in older.manifest.entries}
        for entry in wanted:
            there = known.get(entry.key)
            if there is not None and there.sha256 == entry.sha256:
                with suppress(MapFileError):
                    kept[entry.key] = older.payload(there)
    return kept


def _write(path: Path, manifest: Manifest, payloads: Mapping[PartKey, bytes]) -> None:
    """Replace the file at ``path`` by one of these parts, all of it or nothing."""
    parts = (Part(entry.key, payloads[entry.key]) for entry in manifest.entries)
    write_parts(path, manifest.facts, parts, stamp_ns=manifest.stamp_ns)
