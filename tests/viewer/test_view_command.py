"""``triquad-view`` of what cannot be shown."""

from pathlib import Path

import pytest
from support.files.changing_store import EMPTY, write_checkpoint
from triquad_tools.commands import inspect, pack
from triquad_tools.commands.view import main


def told(arguments: list[str], capsys: pytest.CaptureFixture[str], status: int = 2) -> str:
    """The one line that the command ends with, after what it was at."""
    assert main(arguments) == status
    *before, line = capsys.readouterr().err.splitlines()
    assert all("opening" in other for other in before)
    assert line.startswith("triquad-view: ")
    return line


def test_files_that_cannot_be_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign, empty = tmp_path / "foreign.png", tmp_path / "empty"
    foreign.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(1000))
    empty.mkdir()
    for path in (foreign, empty, tmp_path / "nowhere"):
        assert str(path) in told([str(path)], capsys)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_damaged_map_has_the_same_words_and_status_in_all_commands(
    share: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(write_checkpoint(tmp_path, 1, EMPTY).read_bytes())
    data[len(data) // 3] ^= 0x10
    path = tmp_path / "map.triquad"
    path.write_bytes(data[: int(share * len(data))])
    line = told([str(path)], capsys, status=1).partition(": ")[2]
    assert line.startswith(f"{path} is damaged: ")
    assert "triquad-pack --recover saves what is intact" in line
    for command, *arguments in ((inspect.main,), (pack.main, str(tmp_path / "out.triquad"))):
        assert command([str(path), *arguments]) == 1
        assert capsys.readouterr().err.partition(": ")[2].strip() == line


@pytest.mark.parametrize("option", ["--connect", "--map", "--config"])
def test_a_file_and_a_server_exclude_each_other(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "for a server, not for a file" in told(["map.triquad", option, "x"], capsys)


@pytest.mark.parametrize("host", ["", "nowhere.invalid", "192.0.2.1", "127.0.0.1:80", "a" * 100])
def test_addresses_that_are_not_ours_are_refused(
    host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_checkpoint(tmp_path, 1, EMPTY)
    assert f"cannot serve a page at {host!r}" in told([str(path), "--host", host], capsys)
