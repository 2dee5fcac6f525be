"""The table of a campaign, in Markdown."""

from collections.abc import Mapping, Sequence

from bench.campaign.record import PartRecord, Record
from bench.campaign.turn import Part


def markdown(parts: Sequence[Part], record: Record, missing: Mapping[str, str]) -> str:
    """Return a row for each part: what was done, what became of it, and how many promises broke."""
    lines = [
        "| part | done | of which | most seen | minutes | broken |",
        "|---|---|---|---|---|---|",
    ]
    lines += [_row(part, record.of(part.name)) for part in parts]
    lines += [f"| {name} | skipped: {why} | | | | |" for name, why in missing.items()]
    turns = sum(part.turns for part in record.parts.values())
    broken = sum(len(part.broken) for part in record.parts.values())
    lines.append("")
    lines.append(f"{record.seconds / 60:.0f} minutes, {turns} turns, {broken} promises broken.")
    return "\n".join(lines)


def _row(part: Part, done: PartRecord) -> str:
    kinds = {what: count for what, count in done.counts.items() if what != "done" and count}
    became = ", ".join(f"{count:,} {what}" for what, count in sorted(kinds.items()))
    seen = ", ".join(f"{name}: {value:,.1f}" for name, value in sorted(done.most_seen.items()))
    cells = [part.name, f"{done.done:,} {part.unit}", became, seen]
    return "| " + " | ".join([*cells, f"{done.seconds / 60:.0f}", str(len(done.broken))]) + " |"
