"""The log of a process, as text and as JSON."""

import json
import signal
import subprocess
import sys
from typing import Any

import triquad_client
from support import servers
from triquad_format.wire import codec, keys

ALL_SORTS = """
import os, sys, threading, warnings
from triquad_server.process.log import start_log

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
os.write(2, b"thread 'tx-0' panicked\\n")
raise KeyError("in the main thread")
"""
FOREIGN = "thread 'tx-0' panicked"


def failing_process(log_format: str) -> list[str]:
    """What a process says in which all sorts of things go wrong."""
    command = [sys.executable, "-c", ALL_SORTS, log_format]
    done = subprocess.run(command, capture_output=True, text=True, timeout=servers.WAIT_S)
    assert (done.returncode, done.stdout) == (1, "")
    return done.stderr.splitlines()


def records(lines: list[str]) -> list[dict[str, Any]]:
    """The objects of a log, each of which has what belongs to it."""
    objects = [json.loads(line) for line in lines]
    for fields in objects:
        assert {"time", "level", "logger", "message", "thread"} <= fields.keys()
    return objects


def test_whatever_goes_wrong_in_python_is_json_and_what_libraries_write_is_left_as_it_is() -> None:
    lines = failing_process("json")
    lines.remove(FOREIGN)
    log = records(lines)
    told = {(fields["logger"], fields["level"], fields["message"]) for fields in log}
    assert ("triquad_server", "ERROR", "an exception ended thread mapper") in told
    assert ("triquad_server", "CRITICAL", "an exception ended the server") in told
    (warned,) = (fields["message"] for fields in log if fields["logger"] == "py.warnings")
    assert "UserWarning: worn\nout" in warned
    exceptions = [fields["exception"] for fields in log if "exception" in fields]
    for last in ("ValueError: in a thread", "ValueError: while it goes", "KeyError: 'in the main"):
        assert any(last in exception.splitlines()[-1] for exception in exceptions)
    (of_thread,) = (fields for fields in log if fields["message"].endswith("thread mapper"))
    assert of_thread["thread"] == "mapper"


def test_the_same_as_text() -> None:
    lines = failing_process("text")
    assert any(line.endswith("ERROR an exception ended thread mapper") for line in lines)
    assert "    ValueError: in a thread" in lines
    assert any(r"UserWarning: worn\nout" in line for line in lines)
    assert FOREIGN in lines


def test_a_server_logs_in_json_from_its_start_to_its_end(monkeypatch) -> None:
    monkeypatch.setenv("TRIQUAD_LOG_FORMAT", "json")
    arguments = ["--settings", servers.SMALL_FILE, "--log-level", "debug", "--map", "lab"]
    with servers.server_process(arguments) as server:
        with triquad_client.connect(server.endpoint, "lab") as client:
            assert client.maps() == ["lab"]
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
    assert any("the map is not kept when the server stops" in message for message in messages)
    assert messages[-1] == "stopped"
    assert all(fields["logger"].startswith("triquad") for fields in log)
    assert "forged\x1b" not in messages


def test_what_is_wrong_at_the_start_is_json() -> None:
    arguments = ["--set", "service.scan_que=3", "--log-format", "json"]
    with servers.server_process(arguments, ready=False) as server:
        assert server.wait() == 2
    (fields,) = records(server.lines)
    assert "unknown setting service.scan_que" in fields["message"]
