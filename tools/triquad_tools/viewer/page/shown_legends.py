"""What colours and lines of a scene mean now: for those who save a picture of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from triquad_tools.viewer.page.legend import Scale


class LineMeaning(NamedTuple):
    """What lines of one look say."""

    colour: str  # as in #rrggbb
    dashed: bool
    text: str


@dataclass(frozen=True)
class ShownLegends:
    """Of one page. A layer enters what it shows under its name, and takes it away again."""

    scales: dict[str, Scale] = field(default_factory=dict)
    lines: dict[str, Sequence[LineMeaning]] = field(default_factory=dict)


def lines_html(lines: Sequence[LineMeaning]) -> str:
    """The lines for the panel."""
    return "".join(
        '<div style="padding: 0 1.3em; font-size: 0.8em">'
        '<span style="display: inline-block; width: 2.5em; vertical-align: middle; '
        f"margin-right: 0.6em; border-top: 3px {'dashed' if line.dashed else 'solid'} "
        f'{line.colour}"></span>{line.text}</div>'
        for line in lines
    )
