"""One turn of a part of the campaign: what it is given, what it did, and what broke."""

import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path


class BrokenError(Exception):
    """A promise that the program did not keep; the text says which, and how it was seen."""


@dataclass
class Turn:
    """A turn, whose seed decides all that is drawn at random in it."""

    seed: int
    folder: Path  # its own; it stays where something broke
    most: int  # how many things are done, at most
    seconds: float  # nothing new is begun after them
    counts: Counter[str] = field(default_factory=Counter)
    most_seen: dict[str, float] = field(default_factory=dict)  # the largest of each measurement
    broken: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self._ends_s = time.monotonic() + self.seconds

    @property
    def over(self) -> bool:
        """Whether nothing new is to be begun."""
        return self.counts["done"] >= self.most or time.monotonic() >= self._ends_s

    def did(self, what: str, count: int = 1) -> None:
        """Count a thing that the turn is about, and what became of it."""
        self.counts["done"] += count
        self.counts[what] += count

    def measured(self, name: str, value: float) -> None:
        """Record a measurement, of which the largest is kept."""
        self.most_seen[name] = max(value, self.most_seen.get(name, value))

    def broke(self, text: str) -> None:
        """Record a promise that was not kept."""
        self.broken.append(text)


@dataclass(frozen=True)
class Part:
    """One kind of trouble that the campaign makes."""

    name: str
    unit: str  # of what it counts
    run: Callable[[Turn], None]
    goal: int  # how many in a whole campaign
    per_turn: int
    missing: Callable[[], str | None] = lambda: None
    """The reason why the part cannot run on this machine, if it cannot."""
