"""What the turns of a campaign found: a file for each of them, and a table of all."""

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from bench.campaign.turn import Part


@dataclass(frozen=True)
class TurnResult:
    """What one turn did."""

    seed: int
    counts: dict[str, int]
    most_seen: dict[str, float]
    broken: list[str]
    seconds: float

    @property
    def done(self) -> int:
        """The number of things that the part counts."""
        return self.counts.get("done", 0)

    @classmethod
    def read(cls, path: Path) -> "TurnResult":
        """Return what is in the file of a turn."""
        return cls(**json.loads(path.read_text()))

    def write(self, path: Path) -> None:
        """Write the file of the turn as a whole, or not at all."""
        new = path.with_suffix(".new")
        new.write_text(json.dumps(asdict(self), indent=1))
        os.replace(new, path)


def results(folder: Path, part: Part) -> list[TurnResult]:
    """Return the results of all turns of a part."""
    return [TurnResult.read(file) for file in folder.glob(f"{part.name}-*.json")]


def table(parts: Sequence[Part], folder: Path, missing: Mapping[str, str]) -> str:
    """Return a row for each part, in Markdown: what was done, what became of it, what broke."""
    lines = [
        "| part | done | of which | most seen | minutes | broken |",
        "|---|---|---|---|---|---|",
    ]
    lines += [_row(part, results(folder, part)) for part in parts]
    lines += [f"| {name} | skipped: {why} | | | | |" for name, why in missing.items()]
    turns = [turn for part in parts for turn in results(folder, part)]
    broken = sum(len(turn.broken) for turn in turns)
    lines += ["", f"{len(turns)} turns, {broken} promises broken."]
    return "\n".join(lines)


def _row(part: Part, turns: Sequence[TurnResult]) -> str:
    counts: Counter[str] = Counter()
    most_seen: dict[str, float] = {}
    for turn in turns:
        counts.update(turn.counts)
        for name, value in turn.most_seen.items():
            most_seen[name] = max(value, most_seen.get(name, value))
    done = f"{counts.pop('done', 0):,} {part.unit}"
    became = ", ".join(f"{count:,} {what}" for what, count in sorted(counts.items()) if count)
    seen = ", ".join(f"{name}: {value:,.1f}" for name, value in sorted(most_seen.items()))
    minutes = sum(turn.seconds for turn in turns) / 60
    broken = sum(len(turn.broken) for turn in turns)
    return f"| {part.name} | {done} | {became} | {seen} | {minutes:.0f} | {broken} |"
