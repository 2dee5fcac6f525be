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

_ABOUT = {
    "answers": "How right the answers of a map are, and how fast, for one planner and for sixteen.",
    "batch": "A map of a recording by one process and by several workers.",
    "city": "Streets that are longer than memory: 1.6, 5 and 20 km, driven at 10 m/s.",
    "core": "The map in one process, without a network. The baseline is torch on all cores.",
    "file": "How small map files are, how close to the live map, and how soon they are open.",
    "maps": "Two maps in one server, and each of them in a server of its own.",
    "merge": "A street by two robots whose maps are merged, and by one robot.",
    "moving": "Places where things come and go, and a robot at rest.",
    "poses": "Maps after their poses were corrected, and how long a correction takes.",
    "presets": "The places and sensors that the presets are for, streamed at 10 Hz.",
    "server": "A server process, a lidar at 10 Hz and a planner, through the network.",
    "shared": "A map that four servers share. One is killed, and another one joins.",
    "start": "How long a server takes to start.",
    "viewer": "The viewer in a browser without a GPU.",
}
"""What each part measures, for readers of the page."""

_TOLD = {
    "answers": r"nearest surface seen: distance error, mean|.*(clients' medians|network, median)"
    r"|confidence (0\.00 to|.* to 1\.00).*",
    "city": r".*a scan, first tenth",
    "file": r"parameters of the map|int8 file",
    "moving": r".*: (static|thin things) lost",
    "poses": r".*: F before|scan log, per km",
    "presets": r".*: (accuracy, mean|resident memory of the server)",
    "server": r"100,000 points through the network",
    "shared": r"one server: F|.*time of the drive, of one's",
    "start": r"resident memory after that",
}
"""Figures without a target that say something to a user, as patterns of their names. Of other
parts all are told; those that are not told are in the files.
"""


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
    """Return the page of all results in a folder, without zeros that are zero as wanted."""
    found = (Result.read(folder, path.stem) for path in sorted(folder.glob("*.json")))
    sections = (_section(result) for result in found if result is not None)
    text = (RESULTS / "page.md").read_text(encoding="utf-8")
    return text.replace("{tables}", "\n".join(sections))


def write_page(folder: Path) -> None:
    """Write the page, if the folder is that of the project."""
    if folder == RESULTS:
        PAGE.write_text(page(folder), encoding="utf-8")


def _section(result: Result) -> str:
    lines = [f"## {result.title}", "", _ABOUT[result.part], ""]
    lines += ["| figure | measured | wanted |", "|---|---|---|"]
    told = re.compile(_TOLD.get(result.part, ".*"))
    for one in result.figures:
        if one.kept and one.at_most == 0:
            continue
        if one.wanted:
            wanted = one.wanted if one.kept else f"{one.wanted}: **missed**"
            lines.append(f"| {one.name} | {one.shown} | {wanted} |")
        elif told.fullmatch(one.name):
            lines.append(f"| {one.name} | {one.shown} | |")
    lines += ["", result.remark, ""] if result.remark else [""]
    return "\n".join(lines)
