"""Which checkpoints stay."""

from collections.abc import Sequence
from dataclasses import dataclass

from triquad_server.settings import StoreSettings

MIN_KEPT = 2
"""The newest checkpoints that always stay: should one be damaged, there is another."""


@dataclass(frozen=True)
class KeptCheckpoint:
    """What retention asks of a checkpoint."""

    stamp_ns: int  # when it was written, nanoseconds since 1970
    files: frozenset[str]  # that it consists of


@dataclass(frozen=True)
class Retention:
    """How far back checkpoints are kept; 0 sets no limit."""

    count: int = 0
    age_s: float = 0.0
    total_bytes: int = 0

    @classmethod
    def chosen(cls, settings: StoreSettings) -> "Retention":
        """What the settings say."""
        return cls(settings.keep, settings.keep_age_s, settings.keep_bytes)

    def kept(
        self, checkpoints: Sequence[KeptCheckpoint], sizes: dict[str, int], now_ns: int
    ) -> int:
        """How many stay of ``checkpoints``, which are sorted, the newest first.

        ``sizes`` are the bytes of each file; files that several checkpoints need count once.
        """
        needed: set[str] = set()
        for number, checkpoint in enumerate(checkpoints):
            needed |= checkpoint.files
            total = sum(sizes.get(name, 0) for name in needed)
            too_many = 0 < self.count <= number
            too_old = 0 < self.age_s * 1e9 < now_ns - checkpoint.stamp_ns
            too_large = 0 < self.total_bytes < total
            if number >= MIN_KEPT and (too_many or too_old or too_large):
                return number
        return len(checkpoints)
