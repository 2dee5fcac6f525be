"""Checkpoints that must stay for a while, and how long they have been protected."""

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import MapFileError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files
from triquad_format.mapfile.index import DAMAGED_SUFFIX
from triquad_format.mapfile.protections import (
    PROTECTIONS_NAME,
    Protection,
    Protections,
    Restored,
    read_protections,
    write_protections,
)

_log = logging.getLogger(__name__)

_HOUR_S = 3600.0


@dataclass(frozen=True)
class Clocks:
    """The two clocks that measure how long something has been protected."""

    monotonic_s: Callable[[], float] = time.monotonic
    wall_ns: Callable[[], int] = time.time_ns  # since 1970; may be set to anything at any time


class ProtectedCheckpoints:
    """Keeps a folder's protected checkpoints, in memory and in a file that outlives the server.

    While the server runs, only the monotonic clock measures a protection's age: no jump of the
    time of day ends it. The time of day counts for the time between two servers only, and never
    backwards.
    """

    def __init__(self, folder: Path, protect_h: float, clocks: Clocks | None = None) -> None:
        """Read the list in the folder. Where it is damaged, all is protected.

        Raises:
            OSError: the folder cannot be read.
        """
        self._folder = folder
        self._protect_s = protect_h * _HOUR_S
        self._clocks = clocks or Clocks()
        listed = self._read()
        self.restored = listed.restored  # the last time that the map was restored
        away_s = 0.0
        if listed.listed_ns > 0:
            away_s = max(0.0, (self._clocks.wall_ns() - listed.listed_ns) / 1e9)
        self._started_s = self._clocks.monotonic_s()
        # Ages as of the start of this server; those made since have negative ones.
        self._entries = {
            one.epoch: Protection(one.epoch, one.age_s + away_s, one.why)
            for one in listed.checkpoints
        }

    @property
    def epochs(self) -> frozenset[int]:
        """The epochs that must stay now."""
        return frozenset(one.epoch for one in self._entries.values() if self._lasts_s(one) > 0)

    @property
    def first_ends_h(self) -> float:
        """The hours until the first protection ends; 0 where there is none."""
        return max(0.0, min(map(self._lasts_s, self._entries.values()), default=0.0)) / _HOUR_S

    def add(self, epoch: int, why: str) -> None:
        """Protect a checkpoint from now on.

        Raises:
            OSError: the list cannot be written; nothing has changed.
        """
        age_s = self._started_s - self._clocks.monotonic_s()
        self._write({**self._entries, epoch: Protection(epoch, age_s, why)}, self.restored)

    def remove(self, epoch: int) -> None:
        """End the protection of a checkpoint.

        Raises:
            OSError: the list cannot be written; nothing has changed.
        """
        self._write({e: one for e, one in self._entries.items() if e != epoch}, self.restored)

    def set_restored(self, restored: Restored, why: str) -> None:
        """Record that the map was restored, and protect the checkpoint that it went on from.

        Raises:
            OSError: the list cannot be written; nothing has changed.
        """
        age_s = self._started_s - self._clocks.monotonic_s()
        protection = Protection(restored.as_epoch, age_s, why)
        self._write({**self._entries, restored.as_epoch: protection}, restored)

    def renew(self, there: Iterable[int]) -> None:
        """Update the listed ages, and remove what has ended or is not ``there``.

        So the time of day, should it be wrong, counts from this moment on at most.
        """
        if not self._entries:
            return
        kept = self.epochs.intersection(there)
        try:
            self._write({e: self._entries[e] for e in self._entries if e in kept}, self.restored)
        except OSError as error:
            _log.warning("the protected checkpoints cannot be listed anew: %s", error)

    def _lasts_s(self, one: Protection) -> float:
        return self._protect_s - self._age_s(one)

    def _age_s(self, one: Protection) -> float:
        return max(0.0, one.age_s + self._clocks.monotonic_s() - self._started_s)

    def _write(self, entries: dict[int, Protection], restored: Restored | None) -> None:
        aged = (Protection(one.epoch, self._age_s(one), one.why) for one in entries.values())
        listed_ns = max(0, self._clocks.wall_ns())
        write_protections(self._folder, Protections(listed_ns, tuple(aged), restored))
        self._entries, self.restored = entries, restored

    def _read(self) -> Protections:
        try:
            return read_protections(self._folder)
        except MapFileError as error:
            _log.warning("%s: all checkpoints there are protected for %g h", error, self._hours)
        path = self._folder / PROTECTIONS_NAME
        path.replace(path.with_name(path.name + DAMAGED_SUFFIX))
        epochs = sorted({file.epoch for file in checkpoint_files(self._folder)})
        why = "the list of what is protected was damaged"
        return Protections(0, tuple(Protection(epoch, 0.0, why) for epoch in epochs))

    @property
    def _hours(self) -> float:
        return self._protect_s / _HOUR_S
