"""Texts of others cannot steer the terminal of whoever looks at a map, a file or a server."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import triquad_client
from support.attackers.hostile_server import hostile_server, told
from support.files.mapfile_edit import file_bytes, rewritten
from support.maps.map_records import random_record
from triquad_format.errors import MapFileError
from triquad_format.wire import codec, keys
from triquad_tools.commands import inspect, pack, replay, top
from triquad_tools.console.command import print_line

EVIL = "\x1b]0;owned\x07\x1b[2J\r\x9b31mtext\u202egnp.exe\u2066\nvalid: nothing to see\x00\ud800"
SENT = EVIL.replace("\ud800", "")  # what can be encoded

Main = Callable[[list[str]], int]


def assert_harmless(text: str) -> None:
    assert all(line.isprintable() for line in text.split("\n")), repr(text)
    assert not any(line.startswith("valid:") for line in text.split("\n"))


@pytest.fixture(scope="module")
def map_bytes() -> bytes:
    return file_bytes(random_record(1))


@pytest.fixture
def harmless(capsys: pytest.CaptureFixture[str]) -> Callable[[Main, list[str]], str]:
    """What a command prints, of which nothing does harm."""

    def run(main: Main, arguments: list[str]) -> str:
        main(arguments)
        printed = capsys.readouterr()
        assert_harmless(printed.out)
        assert_harmless(printed.err)
        return printed.out + printed.err

    return run


@pytest.mark.parametrize(
    "field", ["producer", "created", "frame_id", "units", "min_reader_version", "format_version"]
)
def test_metadata_of_a_file(
    field: str, map_bytes: bytes, harmless: Callable[[Main, list[str]], str], tmp_path: Path
) -> None:
    path = tmp_path / "map.triquad"
    path.write_bytes(rewritten(map_bytes, metadata={field: SENT}))
    shown = harmless(inspect.main, [str(path)])
    assert "x1b" in shown or SENT[-5:] not in shown
    harmless(inspect.main, [str(path), "--json"])
    harmless(pack.main, [str(path), str(tmp_path / "out.triquad")])
    try:
        triquad_client.open_map(path).close()
    except MapFileError as error:
        assert_harmless(str(error))


def test_metadata_of_a_million_characters(
    map_bytes: bytes, harmless: Callable[[Main, list[str]], str], tmp_path: Path
) -> None:
    path = tmp_path / "map.triquad"
    path.write_bytes(rewritten(map_bytes, metadata={"producer": "x" * 1_000_000}))
    assert len(harmless(inspect.main, [str(path)])) < 20_000


def test_names_of_files(
    map_bytes: bytes, harmless: Callable[[Main, list[str]], str], tmp_path: Path
) -> None:
    path = tmp_path / EVIL.replace("\x00", "").replace("\ud800", "\udcff")
    path.write_bytes(map_bytes)
    harmless(inspect.main, [str(path)])
    path.write_bytes(map_bytes[:100])
    harmless(inspect.main, [str(path)])
    harmless(pack.main, [str(path), str(tmp_path / "out.triquad")])
    harmless(replay.main, [str(path), "--list"])


def test_words_of_a_server(harmless: Callable[[Main, list[str]], str]) -> None:
    with hostile_server() as server:
        server.lie = told(
            keys.STATUS,
            lambda body: body.update(
                device=SENT, version=SENT, store_error=SENT, warnings=[SENT], scans_lost={SENT: 3}
            ),
        )
        shown = harmless(top.main, ["--connect", server.endpoint, "--once"])
        assert "x1b" in shown
        body = {"triquad": codec.PROTOCOL_VERSION, "kind": "ErrorReply"}
        server.refusal = codec.msgpack.packb({**body, "code": SENT, "message": SENT})
        harmless(top.main, ["--connect", server.endpoint, "--once"])
        harmless(inspect.main, [server.endpoint])


def test_letters_that_a_terminal_does_not_know_are_escapes() -> None:
    code = "from triquad_tools.console.command import print_line; print_line('屋 \\ud800')"
    environment = {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment)
    assert done.stdout == b"\\u5c4b \\ud800\n"


def test_lines_stay_lines(capsys: pytest.CaptureFixture[str]) -> None:
    print_line("one\ntwo\x0bthree\x1b")
    assert capsys.readouterr().out == "one\ntwo\\x0bthree\\x1b\n"
