"""Chooses the checkpoints that stay, without access to files or clocks."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from triquad_server.settings import StoreSettings

_MIN_KEPT = 2
"""The number of newest checkpoints that always stay: should one be damaged, there is another."""


@dataclass(frozen=True)
class KeptCheckpoint:
    """The properties of a checkpoint that decide whether it stays."""

    epoch: int
    stamp_ns: int  # when it was written, nanoseconds since 1970
    files: frozenset[str]  # names of its files


def needed_files(
    checkpoints: Sequence[KeptCheckpoint],
    sizes: Mapping[str, int],
    settings: StoreSettings,
    *,
    protected: Collection[int],
    now_ns: int,
) -> frozenset[str]:
    """Return the names of the files that are needed by checkpoints that stay.

    Args:
        checkpoints: all there are, the newest first.
        sizes: bytes of each file; a file that several checkpoints need counts once.
        settings: how many stay, of what age, and of how many bytes.
        protected: epochs that stay in addition to all these.
        now_ns: the time, nanoseconds since 1970.
    """
    needed: set[str] = set()
    for number, checkpoint in enumerate(checkpoints):
        together = needed | checkpoint.files
        too_many = settings.keep <= number
        too_old = 0 < settings.keep_age_s * 1e9 < now_ns - checkpoint.stamp_ns
        too_large = 0 < settings.keep_bytes < bytes_of(together, sizes)
        if number >= _MIN_KEPT and (too_many or too_old or too_large):
            break
        needed = together
    for checkpoint in checkpoints:
        if checkpoint.epoch in protected:
            needed |= checkpoint.files
    return frozenset(needed)


def bytes_of(files: Collection[str], sizes: Mapping[str, int]) -> int:
    """Return the bytes that files take on disk; deleted ones take nothing."""
    return sum(sizes.get(name, 0) for name in files)
