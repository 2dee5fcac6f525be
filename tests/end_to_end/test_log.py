"""The log of a process, as text and as JSON: nothing but lines of it comes on standard error."""

import json
import signal
import subprocess
import sys
from select import PIPE_BUF
from typing import Any

import pytest
import triquad_client
from support import servers
from triquad_format.wire import codec, keys

ALL_SORTS = """
import os, sys, threading, warnings
from triquad_server.process.log_output import start_log

start_log(sys.argv[1])
warnings.warn("worn\\nout")

def fail():
    raise ValueError("in a thread")

thread = threading.Thread(target=fail, name="mapper")
thread.start()
thread.join()

class Stubborn:
    def __del__(self):
        raise ValueError("while it goes")

Stubborn()
print("printed\\x1b[2J", file=sys.stderr)
os.write(2, b"thread 'tx-0' panicked\\nbytes \\xff" + b"." * 100_000 + b"\\n")
os.write(2, b"a line without an end")
if sys.argv[2] == "abort":
    os.abort()
raise KeyError("in the main thread")
"""


def run(*arguments: str) -> tuple[int, list[str]]:
    """The exit status of a process in which all sorts of things go wrong, and what it says."""
    done = subprocess.run(
        [sys.executable, "-c", ALL_SORTS, *arguments],
        capture_output=True,
        timeout=servers.WAIT_S,
    )
    assert done.stdout == b""
    return done.returncode, done.stderr.decode("utf-8", "backslashreplace").splitlines()


def records(lines: list[str]) -> list[dict[str, Any]]:
    """The objects of a log, each of which has what belongs to it."""
    objects = [json.loads(line) for line in lines]
    for fields in objects:
        assert {"time", "level", "logger", "message", "thread"} <= fields.keys()
    return objects


def test_whatever_goes_wrong_each_line_is_json() -> None:
    status, lines = run("json", "raise")
    log = records(lines)
    assert status == 1
    told = {(fields["logger"], fields["level"], fields["message"]) for fields in log}
    assert ("triquad_server", "ERROR", "an exception ended thread mapper") in told
    assert ("triquad_server", "CRITICAL", "an exception ended the server") in told
    assert ("stderr", "WARNING", "printed\x1b[2J") in told
    assert ("stderr", "WARNING", "thread 'tx-0' panicked") in told
    assert ("stderr", "WARNING", "a line without an end") in told
    (warned,) = (fields["message"] for fields in log if fields["logger"] == "py.warnings")
    assert "UserWarning: worn\nout" in warned
    exceptions = [fields["exception"] for fields in log if "exception" in fields]
    for last in ("ValueError: in a thread", "ValueError: while it goes", "KeyError: 'in the main"):
        assert any(last in exception.splitlines()[-1] for exception in exceptions)
    (of_thread,) = (fields for fields in log if fields["message"].endswith("thread mapper"))
    assert of_thread["thread"] == "mapper"
    assert max(map(len, lines)) <= PIPE_BUF  # what is too long becomes several, each in one piece


def test_the_last_words_of_a_crash_are_json_too() -> None:
    status, lines = run("json", "abort")
    log = records(lines)
    assert status == -signal.SIGABRT
    messages = [fields["message"] for fields in log if fields["logger"] == "stderr"]
    # A stack of each thread, as Python writes it where nothing else works any more.
    assert any("Fatal Python error: Aborted" in message for message in messages)
    assert any('File "<string>", line' in message for message in messages)


def test_text_stays_what_it_was() -> None:
    status, lines = run("text", "raise")
    assert status == 1
    assert any(line.endswith("ERROR an exception ended thread mapper") for line in lines)
    assert "    ValueError: in a thread" in lines
    assert any(r"UserWarning: worn\nout" in line for line in lines)
    assert "thread 'tx-0' panicked" in lines  # what others write is left as it is


@pytest.mark.parametrize("by_environment", [False, True])
def test_a_server_logs_in_json_from_its_start_to_its_end(
    tmp_path, monkeypatch, by_environment
) -> None:
    settings = tmp_path / "server.toml"
    settings.write_text(servers.SMALL_TOML)
    arguments = ["--settings", settings, "--log-level", "debug", "--map", "lab"]
    if by_environment:
        monkeypatch.setenv("TRIQUAD_LOG_FORMAT", "json")
    else:
        arguments += ["--log-format", "json"]
    with servers.server_process(arguments) as server:
        with triquad_client.connect(server.endpoint, "lab") as client:
            servers.learn(client)
        with servers.raw_session("client", connect=server.endpoint) as session:
            peer = servers.RawPeer(session, "lab")
            forged = servers.scan(source='lidar"}\n{"message": "forged\x1b')
            peer.put("lidar", codec.encode(forged))
            assert peer.refusal(keys.SDF, b"\n{}\n") == "bad_request"
        server.process.send_signal(signal.SIGTERM)
        assert server.wait() == 0
    log = records(server.lines)
    messages = [fields["message"] for fields in log]
    assert any(message.startswith("ready: map 'lab'") for message in messages)
    assert messages[-1] == "stopped"
    assert all(fields["logger"].startswith("triquad") for fields in log)
    assert "forged\x1b" not in messages


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--settings", "bad.toml"], "unknown setting service.scan_que"),
        (["--mode", "boat"], "invalid choice: 'boat'"),
        (["--log-level", "loud"], "invalid choice: 'loud'"),
        (["--config", "missing.json5"], "Zenoh configuration"),
    ],
)
def test_what_is_wrong_at_the_start_is_json(tmp_path, monkeypatch, arguments, text) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.toml").write_text("[service]\nscan_que = 3\n")
    with servers.server_process([*arguments, "--log-format", "json"], ready=False) as server:
        assert server.wait() == 2
    assert any(text in fields["message"] for fields in records(server.lines))


def test_a_signal_before_anything_is_open_is_told_in_json() -> None:
    with servers.server_process(["--log-format", "json"], ready=False) as server:
        server.wait_for("preparing compiled code")
        server.process.send_signal(signal.SIGINT)
        assert server.wait() == 0
    assert records(server.lines)[-1]["message"] == "stopped"


def test_a_format_that_there_is_not_is_wrong_usage(monkeypatch) -> None:
    monkeypatch.setenv("TRIQUAD_LOG_FORMAT", "xml")
    with servers.server_process(ready=False) as server:
        assert server.wait() == 2
    assert "'xml', given here or in TRIQUAD_LOG_FORMAT, is no format: use text or json" in (
        server.log
    )
