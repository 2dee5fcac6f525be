"""What messages tell to install brings the library that is missing."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from triquad_tools.commands import entry_points

ROOT = Path(entry_points.__file__).parents[3]
SOURCES = [
    path for each in ("client", "map", "server", "tools") for path in (ROOT / each).rglob("*.py")
]
TOLD = re.compile(r"([\w-]+) is missing[^\n]*?triquad\[(\w+)\]")
SAID = [(*found, path.name) for path in SOURCES for found in TOLD.findall(path.read_text())]
COMMANDS = {
    "demo": {"numba", "pydantic", "viser"},
    "evaluate": {"scipy", "trimesh"},
    "inspect": {"matplotlib", "numba"},
    "keys": {"cryptography", "rich"},
    "map_recording": {"numba", "pydantic", "rich"},
    "pack": {"matplotlib", "numba", "trimesh"},
    "replay": {"laspy", "rich", "rosbags"},
    "ros2": {"rosbags"},
    "top": {"rich"},
    "view": {"matplotlib", "viser"},
}
"""What each of them needs, beyond what the client does."""


def libraries(extra: str) -> Iterator[str]:
    """Yield the libraries that an extra of the package asks for."""
    project = (ROOT / "pyproject.toml").read_text()
    listed = re.search(rf"^{extra} = \[(.*?)\]$", project, re.DOTALL | re.MULTILINE)
    assert listed, f"there is no extra {extra}"
    for name, extras in re.findall(r'"([\w-]+)(?:\[([\w,]+)\])?', listed[1]):
        if name == "triquad":
            for each in extras.split(","):
                yield from libraries(each)
        else:
            yield name


@pytest.mark.parametrize(("library", "extra", "file"), SAID)
def test_the_extra_that_a_message_names_brings_the_library(
    library: str, extra: str, file: str
) -> None:
    assert library in libraries(extra), file


def test_messages_are_found() -> None:
    assert {("pandas", "notebook"), ("matplotlib", "notebook"), ("trimesh", "mesh")} <= {
        (library, extra) for library, extra, _ in SAID
    }


@pytest.mark.parametrize("name", COMMANDS)
def test_the_extra_that_a_command_names_brings_all_it_needs(name: str) -> None:
    options = getattr(entry_points, name).keywords
    assert COMMANDS[name] | {*options.get("needs", ())} - {"foxglove_schemas_protobuf"} <= {
        *libraries(options.get("extra", "tools"))
    }
