"""What the packages import is what ``pyproject.toml`` declares."""

import ast
import re
import sys
from pathlib import Path

import pytest
import triquad_format

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DISTRIBUTIONS = {
    "PIL": "pillow",
    "zenoh": "eclipse-zenoh",
    "google": "protobuf",
    "skimage": "scikit-image",
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "pydantic_core": "pydantic",
    "prometheus_client": "prometheus-client",
    "small_gicp": "small-gicp",
}
EVERY_EXTRA = tuple(PROJECT["optional-dependencies"].keys() - {"demo", "dev", "docs"})


def declared(*extras: str) -> set[str]:
    """Names of the distributions that the base and some extras need."""
    listed = [*PROJECT["dependencies"]]
    for extra in extras:
        listed += PROJECT["optional-dependencies"][extra]
    names = [entry.split(";")[0].split("[")[0].split("<")[0].split(">")[0] for entry in listed]
    return {name.strip() for name in names} - {"triquad"}


def imported(folder: str) -> set[str]:
    """Names of the distributions that the modules of a folder import."""
    modules = set()
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                modules |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                modules.add(node.module.split(".")[0])
    foreign = {
        name
        for name in modules - sys.stdlib_module_names - {"tomllib", "_typeshed"}
        if not name.startswith("triquad_")
    }
    return {DISTRIBUTIONS.get(name, name) for name in foreign}


@pytest.mark.parametrize(
    ("folder", "extras"),
    [
        ("format", ()),
        ("client", ("mesh", "open3d")),
        ("map", ("fast", "notebook", "preview")),
        ("server", ("fast", "gpu", "preview", "server")),
        ("tools", EVERY_EXTRA),
        ("tools/triquad_tools/credentials", ("keys",)),
        ("tools/triquad_tools/viewer", ("fast", "mesh", "preview", "ros", "tools", "viewer")),
        ("tools/triquad_tools/commands", ("ros", "tools")),
        ("tools/triquad_tools/work", ("fast", "mesh", "preview", "ros", "tools")),
        ("tools/triquad_tools/recordings", ("fast", "mesh", "preview", "ros", "tools")),
        ("tools/triquad_tools/ros2", ("fast", "mesh", "preview", "ros", "tools")),
    ],
)
def test_what_is_imported_is_declared(folder: str, extras: tuple[str, ...]) -> None:
    assert imported(folder) <= declared(*extras)


def test_what_is_declared_is_imported() -> None:
    folders = ("format", "map", "client", "server", "tools")
    used = set().union(*(imported(folder) for folder in folders))
    assert declared(*EVERY_EXTRA) <= used


def test_badges_say_what_is_declared() -> None:
    badges = re.findall(r"img\.shields\.io/badge/([^)]*)\)", (ROOT / "README.md").read_text())
    minors = [int(each) for each in re.findall(r"Python :: 3\.(\d+)", str(PROJECT["classifiers"]))]
    assert PROJECT["requires-python"] == f">=3.{min(minors)}"
    python = f"python-3.{min(minors)}_to_3.{max(minors)}-blue"
    assert badges == [python, f"licence-{PROJECT['license']}-blue", "platform-Linux-blue"]
    assert "Operating System :: POSIX :: Linux" in PROJECT["classifiers"]


def test_the_version_is_told_alike() -> None:
    version = re.escape(triquad_format.__version__)
    for name, line in (
        ("CITATION.cff", f"version: {version}"),
        ("CHANGELOG.md", f"## {version}"),
        ("docs/versions.md", rf"\| the program \| {version}"),
    ):
        assert re.search(f"^{line}\\b", (ROOT / name).read_text(), re.MULTILINE), name
