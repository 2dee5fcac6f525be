"""Figures of each part as JSON, and the page of the documentation that is made of them."""

import json
import math
import os
import platform
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from triquad_tools.console.report import json_text

from bench.figures import Figure

_HERE = Path(__file__).parent
RESULTS = _HERE / "results"
PAGE = _HERE.parent / "docs" / "benchmarks.md"


@dataclass(frozen=True)
class Result:
    """The measurement of one part at one time."""

    part: str
    date: str  # ISO 8601
    machine: str  # in words
    street: int  # seed of streets, rooms and tables
    figures: list[Figure]
    remark: str = ""  # what is missed, and why: written by hand, kept in later measurements

    @property
    def title(self) -> str:
        """The part, and where and when it was measured."""
        return f"{self.part}: {self.date}, {self.machine}, street {self.street}"

    @classmethod
    def read(cls, folder: Path, part: str) -> "Result | None":
        """Return the newest result of a part; ``None``: it was never measured."""
        path = folder / f"{part}.json"
        if not path.exists():
            return None
        fields = json.loads(path.read_text(encoding="utf-8"))
        figures = [_figure(saved) for saved in fields.pop("figures")]
        return cls(figures=figures, **fields)

    def write(self, folder: Path) -> None:
        """Save this as the newest result of its part."""
        folder.mkdir(parents=True, exist_ok=True)
        text = json_text(asdict(self)) + "\n"
        (folder / f"{self.part}.json").write_text(text, encoding="utf-8")


def _figure(saved: dict[str, Any]) -> Figure:
    value = math.nan if saved["value"] is None else saved["value"]  # JSON has no NaN
    return Figure(**{**saved, "value": value})


def machine(device: str) -> str:
    """Return the machine in words, and its GPU where that is what trained."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*: (.*)", cpuinfo.read_text()) if cpuinfo.exists() else None
    name = found[1] if found else platform.processor() or platform.machine()
    if device == "cuda":
        import torch  # its import takes 200 MB

        name = f"{torch.cuda.get_device_name()} beside {name}"
    return f"{name}, {os.cpu_count()} cores, Python {platform.python_version()}"


def page(folder: Path) -> str:
    """Return the page of all results in a folder: a table of bounded ones, the rest in a line."""
    found = (Result.read(folder, path.stem) for path in sorted(folder.glob("*.json")))
    sections = (_section(result) for result in found if result is not None)
    text = (RESULTS / "page.md").read_text(encoding="utf-8")
    return text.replace("{tables}", "\n".join(sections))


def write_page(folder: Path) -> None:
    """Write the page, if the folder is that of the project."""
    if folder == RESULTS:
        PAGE.write_text(page(folder), encoding="utf-8")


def _section(result: Result) -> str:
    lines = [f"## {result.title}", ""]
    bounded = [figure for figure in result.figures if figure.wanted]
    if bounded:
        lines += ["| figure | measured | wanted | kept |", "|---|---|---|---|"]
        for one in bounded:
            kept = "yes" if one.kept else "**no**"
            lines.append(f"| {one.name} | {one.shown} | {one.wanted} | {kept} |")
        lines.append("")
    others = [f"{one.name} {one.shown}" for one in result.figures if not one.wanted]
    also = f"Also measured: {'; '.join(others)}." if others else ""
    lines += [" ".join(filter(None, (result.remark, also))), ""]
    return "\n".join(lines)
