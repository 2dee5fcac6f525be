"""The progress of a campaign: a file that is replaced after each turn."""

import json
import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class TurnResult:
    """The results of a turn, as its process reported."""

    counts: dict[str, int]
    most_seen: dict[str, float]
    broken: list[str]
    seconds: float


@dataclass
class PartRecord:
    """All turns of a part."""

    turns: int = 0
    seconds: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    most_seen: dict[str, float] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)  # each with the seed of its turn

    @property
    def done(self) -> int:
        """The number of things that the part counts."""
        return self.counts["done"]

    def add(self, seed: int, result: TurnResult) -> None:
        """Count a turn."""
        self.turns += 1
        self.seconds += result.seconds
        self.counts.update(result.counts)
        for name, value in result.most_seen.items():
            self.most_seen[name] = max(value, self.most_seen.get(name, value))
        self.broken += [f"--seed {seed}: {text}" for text in result.broken]


@dataclass
class Record:
    """The campaign's file."""

    path: Path
    seconds: float = 0.0  # of all runs together
    parts: dict[str, PartRecord] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> "Record":
        """Return the record in a file, or a new one where there is none."""
        if not path.exists():
            return cls(path)
        told = json.loads(path.read_text())
        parts = {
            name: PartRecord(**{**part, "counts": Counter(part["counts"])})
            for name, part in told["parts"].items()
        }
        return cls(path, told["seconds"], parts)

    def of(self, part: str) -> PartRecord:
        """Return the record of a part."""
        return self.parts.setdefault(part, PartRecord())

    def write(self) -> None:
        """Replace the file."""
        parts = {name: vars(part) for name, part in self.parts.items()}
        new = self.path.with_suffix(".new")
        new.write_text(json.dumps({"seconds": self.seconds, "parts": parts}, indent=1))
        os.replace(new, self.path)
