"""What pages show is run: Python against a server, commands by the parsers of their options."""

import argparse
import importlib
import re
import shlex
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import triquad_client
from support import servers
from support.maps import small_world
from support.pages import PARSERS, commands, python_blocks

CONNECTING = re.compile(r"(\bconnect(?:_async)?\()\s*(?:\"[^\"]*\"|config=\"[^\"]*\")")
NAMED = re.compile(r"(\bconnect\([^)]*?)(, \"garage\"|, \"town\"|, map=\"demo\")")

ELSEWHERE = {
    "keyframe_stamps_s": "is of docs/examples/correct_poses.py, which is run",
    "async with client.watch_mesh": "is of a coroutine: tests/client/mesh/test_mesh_watch.py",
}
"""What blocks have that are not run here, and what is done instead."""

SHORTER = {
    "while True:": "for _ in range(2):",
    "while driving:": "for _ in range(2):",
    "for update in watch:": "for update in [next(iter(watch))]:",
    "time.sleep(10)": "time.sleep(0.1)",
}
"""What goes on for ever or waits for long, and what is run instead."""

BLOCKS = python_blocks()
COMMANDS = commands()


def statements(block: str) -> str:
    """What is run of a block: of a dialogue, what its reader types."""
    if block.startswith(">>> "):
        return "\n".join(re.findall(r"^>>> (.*)$", block, re.MULTILINE))
    for long, short in SHORTER.items():
        block = block.replace(long, short)
    return block


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with servers.running_service() as endpoint, triquad_client.connect(endpoint) as client:
        for scan in small_world.world(3).scans:
            client.publish_scan(scan.points, scan.world_from_sensor)
        client.flush(servers.WAIT_S)
        client.create_map("yard")
        yield endpoint


@pytest.fixture
def names(
    endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[dict[str, Any]]:
    """What the text around a block speaks of."""
    monkeypatch.chdir(tmp_path)
    scan = small_world.world(3).scans[0]
    depth = np.full((48, 64), 3.0)
    with triquad_client.connect(endpoint) as client, ExitStack() as stack:
        client.download_map(tmp_path / "site.triquad")
        shutil.copy(tmp_path / "site.triquad", tmp_path / "map.triquad")
        offline = stack.enter_context(triquad_client.open_map(tmp_path / "site.triquad"))
        yield {
            "np": np,
            "triquad_client": triquad_client,
            "client": client,
            "points": scan.points,
            "world_from_sensor": scan.world_from_sensor,
            "directions": np.array([[0.0, 0.0, 1.0]]),
            "cloud": np.ones((64, 1024, 3)),
            "bounds": ((0, -8, -1), (10, 8, 5)),
            "depth": depth,
            "intrinsics": triquad_client.Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5),
            "world_from_camera": scan.world_from_sensor,
            "offline": offline,
        }


@pytest.mark.parametrize(("name", "block"), BLOCKS, ids=[name for name, _ in BLOCKS])
def test_python_runs_as_it_is_shown(
    name: str, block: str, names: dict[str, Any], endpoint: str
) -> None:
    for text, why in ELSEWHERE.items():
        if text in block:
            pytest.skip(why)
    block = NAMED.sub(r"\1", statements(block))
    exec(compile(CONNECTING.sub(rf'\1"{endpoint}"', block), name, "exec"), names)  # noqa: S102


def test_whatever_is_not_run_is_on_some_page() -> None:
    texts = "".join(block for _, block in BLOCKS)
    assert [text for text in [*ELSEWHERE, *SHORTER] if text not in texts] == []
    assert len(BLOCKS) > 25


@pytest.mark.parametrize("command", PARSERS)
def test_commands_have_the_options_that_are_shown(command: str) -> None:
    module, parser = PARSERS[command]
    lines = [line for line in COMMANDS if line.split(" ")[0] == command]
    assert lines
    for line in lines:
        words = shlex.split(line, comments=True)[1:]
        made: argparse.ArgumentParser = getattr(importlib.import_module(module), parser)()
        if command == "triquad-eval" and words[0] == "paper":
            made, words = importlib.import_module(module)._paper_parser(), words[1:]
        try:
            made.parse_args(words)
        except SystemExit as stop:
            pytest.fail(f"{line} ends with {stop.code}")
