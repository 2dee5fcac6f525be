"""What all commands have in common, as processes."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import triquad_format
from support.files.golden import FOLDER
from triquad_format.mapfile.reader import read_map

COMMANDS = (
    "demo", "evaluate", "inspect", "keys", "map_recording", "pack", "replay", "ros2", "top", "view"
)  # fmt: skip
SLOW = {
    "argcomplete",
    "matplotlib",
    "numba",
    "pydantic",
    "rich",
    "scipy",
    "torch",
    "trimesh",
    "viser",
    "zenoh",
}
"""What no one waits for who asks for help."""
WAIT_S = 60.0


def command(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    code = f"import sys; from triquad_tools.commands.entry_points import {name}; sys.exit({name}())"
    line = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, timeout=WAIT_S)


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_tells_its_version(name: str) -> None:
    done = command(name, "--version")
    assert (done.returncode, done.stdout) == (0, f"triquad {triquad_format.__version__}\n")


HELP = """
import sys
from importlib import import_module
try:
    import_module(sys.argv[1]).main(["--help"])
except SystemExit:
    print("LOADED", *sys.modules)
"""


@pytest.mark.parametrize(
    "module", ["triquad_server.cli", *(f"triquad_tools.commands.{name}" for name in COMMANDS)]
)
def test_help_waits_for_no_library_that_is_slow_to_import(module: str) -> None:
    line = [sys.executable, "-c", HELP, module]
    done = subprocess.run(line, capture_output=True, text=True, timeout=WAIT_S)
    told, loaded, names = done.stdout.partition("LOADED ")
    assert told.startswith("usage: triquad-")
    assert loaded
    assert "argparse" in names.split()
    assert not SLOW & {*names.split()}


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("demo", ("--scans", "0")),
        ("demo", ("street",)),
        ("evaluate", ("x.ply",)),
        ("evaluate", ("x.ply", "--reference", "y.ply", "--threshold", "0")),
        ("replay", ("x", "--rate", "fast")),
        ("replay", ("x", "--every", "0")),
        ("replay", ("x", "--range-min", "nan")),
    ],
)
def test_wrong_usage_ends_with_code_2(name: str, arguments: tuple[str, ...]) -> None:
    with pytest.raises(SystemExit) as caught:
        import_module(f"triquad_tools.commands.{name}").main(arguments)
    assert caught.value.code == 2


@pytest.mark.parametrize(
    ("entry", "typed", "expected"),
    [
        ("triquad_tools.commands.entry_points:pack", "triquad-pack --max", {"--max-error"}),
        ("triquad_tools.commands.entry_points:map_recording", "triquad-map a b --fo", {"--force"}),
        ("triquad_tools.commands.entry_points:keys", "triquad-keys in", {"init"}),
        ("triquad_server.cli:main", "triquad-server --device c", {"cpu", "cuda"}),
        ("triquad_tools.commands.entry_points:inspect", "triquad-inspect map", {"map.triquad"}),
    ],
)
def test_the_shell_completes_what_was_typed(
    entry: str, typed: str, expected: set[str], tmp_path: Path
) -> None:
    (tmp_path / "map.triquad").touch()
    module, name = entry.split(":")
    code = f"import sys; from {module} import {name}; sys.exit({name}())"
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": typed, "COMP_POINT": str(len(typed))}
    asked |= {"COMP_TYPE": "9", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_SHELL": "bash"}
    done = subprocess.run(
        [
            "bash",
            "-c",
            '"$@" 8>&1 9>&2 1>/dev/null 2>/dev/null',
            "bash",
            sys.executable,
            "-c",
            code,
        ],
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        env={**os.environ, **asked},
        cwd=tmp_path,
    )
    assert {*done.stdout.split()} == expected


def test_closed_streams_are_no_error(tmp_path: Path) -> None:
    entry = "from triquad_tools.commands.entry_points import pack; raise SystemExit(pack())"
    out = tmp_path / "out.triquad"
    line = [sys.executable, "-c", entry, str(FOLDER / "map_v1.triquad"), str(out)]
    done = subprocess.run(["sh", "-c", '"$@" >&- 2>&-', "sh", *line], timeout=WAIT_S)
    assert done.returncode == 0
    assert read_map(out).regions


def test_nobody_who_reads_the_output_is_no_error() -> None:
    code = """
import sys
from triquad_tools.console.command import run

def work():
    for line in range(100_000):
        print(line)
    return 0

sys.exit(run("triquad-test", work))
"""
    line = [sys.executable, "-c", code]
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "0\n"
        process.stdout.close()  # as head does
        assert process.stderr.read() == ""
        assert process.wait(WAIT_S) == 141
