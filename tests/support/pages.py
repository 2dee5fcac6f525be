"""What the pages show: blocks of Python, and commands."""

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts),
]
BLOCK = re.compile(r"^ *```([^`\n]*)\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
SHELL = ("", "sh", "bash")

PARSERS = {
    "triquad-server": ("triquad_server.cli", "_parser"),
    "triquad-demo": ("triquad_tools.commands.demo", "_parser"),
    "triquad-eval": ("triquad_tools.commands.evaluate", "_parser"),
    "triquad-inspect": ("triquad_tools.commands.inspect", "_parser"),
    "triquad-keys": ("triquad_tools.commands.keys", "_parser"),
    "triquad-map": ("triquad_tools.commands.map_recording", "_parser"),
    "triquad-pack": ("triquad_tools.commands.pack", "_parser"),
    "triquad-replay": ("triquad_tools.commands.replay", "_parser"),
    "triquad-ros2": ("triquad_tools.commands.ros2", "parser"),
    "triquad-top": ("triquad_tools.commands.top", "_parser"),
    "triquad-view": ("triquad_tools.commands.view", "_parser"),
}
"""Where the parser of each command is, and its ``main``."""


def blocks(*languages: str) -> Iterator[tuple[str, str]]:
    """A page and the text of each of its blocks in one of these languages."""
    for page in PAGES:
        for language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
            if language in languages:
                yield str(page.relative_to(ROOT)), textwrap.dedent(text)


def python_blocks() -> list[tuple[str, str]]:
    """A name and the text of each block of Python."""
    return [(f"{page}-{number}", text) for number, (page, text) in enumerate(blocks("python"))]


def commands() -> list[str]:
    """The lines of the commands of triquad."""
    lines = (
        line.removeprefix("$ ").strip()
        for _, text in blocks(*SHELL)
        for line in text.replace("\\\n", " ").splitlines()
    )
    return [line for line in dict.fromkeys(lines) if line.split(" ")[0] in PARSERS]
