"""``triquad-top`` with real servers, as a process and on a terminal."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import triquad_client
from support import servers
from support.server_records import METRICS, STATUS
from support.terminal import Terminal, terminal
from triquad_client import Client, ServerMetrics, ServerStatus
from triquad_format.wire import codec, keys
from triquad_tools.commands.top import main

CODE = "import sys; from triquad_tools.commands.entry_points import top; sys.exit(top())"
ENTERED, LEFT = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"


@pytest.fixture(autouse=True)
def no_width_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests that run side by side are told of a terminal of 80 columns, which is not there."""
    for name in ("COLUMNS", "LINES"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with servers.running_service(store=tmp_path_factory.mktemp("store")) as endpoint:
        yield endpoint


@contextmanager
def streaming(endpoint: str) -> Iterator[Client]:
    """A publisher and a planner at work; yields a client of them."""
    over = threading.Event()
    with triquad_client.connect(endpoint) as client:

        def stream() -> None:
            while not over.wait(0.05):
                client.publish_scan(servers.sphere(), np.eye(4), source="roof")
                client.flush(servers.WAIT_S)
                client.query_distance(servers.sphere(100), max_distance_m=5.0)

        worker = threading.Thread(target=stream)
        worker.start()
        try:
            yield client
        finally:
            over.set()
            worker.join()


@contextmanager
def top(endpoint: str, *arguments: str, **options: Any) -> Iterator[Terminal]:
    options = {"environment": {}, **options}
    with terminal(
        CODE, "--connect", endpoint, "--interval", "0.2", *arguments, **options
    ) as opened:
        yield opened


@pytest.mark.parametrize("width", [80, 140])
def test_once_is_the_whole_page_as_text(endpoint, capsys, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    with streaming(endpoint) as client:
        client.checkpoint()
        assert main(["--connect", endpoint, "--once", "--interval", "2"]) == 0
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= width
    assert text.startswith(f"map default at {endpoint}, triquad ")
    for positive in ("taken", "roof", "answered", "distance", "flush", "metrics"):
        assert re.search(rf"{positive} +\d*\.?\d*[1-9]", text), positive
    for name in ("samples /s", "epochs /s", "bytes received", "whole process", "evidence"):
        assert re.search(rf"{name} +[1-9.]+", text), name
    assert re.search(r"last checkpoint +\d+\.\d s ago", text)
    assert re.search(r"client +[2-9]", text)
    assert ("REQUESTS" in text.splitlines()[1]) == (width == 140)


def test_json_has_the_records_of_the_wire(endpoint, capsys):
    with streaming(endpoint):
        assert main(["--connect", endpoint, "--once", "--json", "--interval", "0.5"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    report = json.loads(line)
    assert (report["endpoint"], report["map"], report["silent"]) == (endpoint, "default", None)
    assert set(report["status"]) == {field.name for field in fields(ServerStatus)}
    assert set(report["metrics"]) == {field.name for field in fields(ServerMetrics)}
    assert report["interval_s"] == pytest.approx(0.5, abs=0.4)
    assert report["rates"]["scans_taken"] > 0.0
    asked = report["traffic"]["operations"]["query/distance"]
    assert 0.0 < asked["p50_s"] <= asked["p99_s"]
    assert report["problems"] == []
    assert not report["restarted"]


def test_the_page_is_drawn_again_and_ctrl_c_gives_the_terminal_back(endpoint):
    with streaming(endpoint), top(endpoint) as opened:
        modes = opened.modes
        opened.wait_for(r"taken +[1-9]\d*\.\d")
        assert opened.modes != modes  # what is typed is not shown
        opened.resize(140, 40)
        assert max(map(len, opened.wait_for(r"MAP .*REQUESTS").splitlines())) == 140
        opened.type(b"\x03")
        assert opened.wait() == 130
        assert f"{LEFT}triquad-top: interrupted\r\n" in opened.shown
        assert "Traceback" not in opened.shown
        assert opened.modes == modes


def test_q_ends_it_and_other_keys_do_nothing(endpoint):
    with top(endpoint) as opened:
        opened.wait_for("SCANS")
        opened.type(b"xyz\x1b[A")
        assert "xyz" not in opened.wait_for("SCANS")
        opened.type(b"q")
        assert opened.wait() == 0
        assert opened.shown.endswith(LEFT)


def test_ctrl_z_leaves_the_page_and_comes_back_to_it(endpoint):
    with top(endpoint) as opened:
        opened.wait_for("SCANS")
        opened.type(b"\x1a")  # without a shell that could go on nothing stops here
        while LEFT + ENTERED not in opened.shown:
            opened.wait_for("SCANS")
        opened.type(b"q")
        assert opened.wait() == 0


def test_sigterm_gives_the_terminal_back(endpoint):
    with top(endpoint) as opened:
        opened.wait_for("SCANS")
        os.kill(opened.process, signal.SIGTERM)
        assert opened.wait() == 130
        assert LEFT in opened.shown


def test_a_terminal_that_cannot_be_drawn_on_gets_one_page(endpoint):
    with top(endpoint, environment={"TERM": "dumb"}) as opened:
        assert opened.wait() == 0
        assert "SCANS" in opened.shown
        assert "\x1b" not in opened.shown


def test_no_color_is_heeded(endpoint):
    with top(endpoint, environment={"NO_COLOR": "1"}) as opened:
        opened.wait_for("SCANS")
        assert not re.search(r"\x1b\[[0-9;]*3\dm", opened.shown)
        opened.type(b"q")
        assert opened.wait() == 0


@contextmanager
def lines_of(endpoint: str) -> Iterator[Iterator[dict[str, Any]]]:
    """What ``--json`` prints, until it is interrupted."""
    line = [sys.executable, "-c", CODE, "--connect", endpoint, "--json", "--interval", "0.2"]
    with subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        yield map(json.loads, process.stdout)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=servers.WAIT_S)
        assert (process.returncode, errors) == (130, "triquad-top: interrupted\n")


def test_a_server_that_is_killed_and_started_again_is_noticed(tmp_path: Path) -> None:
    settings = tmp_path / "small.toml"
    settings.write_text(servers.SMALL_TOML)
    arguments = ["--settings", settings]
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
        lines_of(server.endpoint) as reports,
        top(server.endpoint) as opened,
    ):
        servers.learn(client)
        first = next(report for report in reports if report["rates"])
        opened.wait_for(r"taken +\S+ +2\b")
        server.process.kill()
        server.wait()
        silent = next(report for report in reports if report["silent"])
        assert silent["status"] is silent["rates"] is None
        assert "the link to the server is down" in silent["silent"]["reason"]
        page = opened.wait_for(r"!! no answer since \d\d:\d\d:\d\d, for ")
        assert re.search(r"taken +\S+ +2\b", page)
        with servers.server_process(arguments, server.endpoint):
            back = next(report for report in reports if report["status"])
            assert back["restarted"]
            assert back["status"]["server"] != first["status"]["server"]
            assert back["rates"] is back["traffic"] is None
            after = next(report for report in reports if report["rates"])
            assert after["rates"]["scans_taken"] == 0.0
            assert not after["restarted"]
            assert "no answer" not in opened.wait_for(r"taken +0 +0\b")
            opened.type(b"q")
            assert opened.wait() == 0


def by_hand(metrics: ServerMetrics | None) -> Any:
    """A server that answers with made-up records."""
    uptime_s = iter(range(10_000, 20_000))
    answers: dict[str, Any] = {
        keys.STATUS: lambda query, key: query.reply(
            key, codec.encode(replace(STATUS, uptime_s=float(next(uptime_s))))
        )
    }
    if metrics is not None:
        answers[keys.METRICS] = lambda query, key: query.reply(key, codec.encode(metrics))
    return servers.answering(answers)


def test_an_older_server_is_shown_as_far_as_it_tells(capsys):
    with by_hand(None) as endpoint:
        assert main(["--connect", endpoint, "--once", "--interval", "0.1"]) == 0
        text = capsys.readouterr().out
        assert "the server is older" in text
        assert re.search(r"taken +0 +12\.3 k", text)
        assert main(["--connect", endpoint, "--once", "--json", "--interval", "0.1"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["metrics"] is report["traffic"] is None
        assert "the server is older" in report["metrics_missing"]


@pytest.mark.parametrize("bounds_s", [np.zeros(0), np.array([1.0])])
def test_metrics_that_do_not_fit_together_are_refused(capsys, bounds_s):
    with by_hand(replace(METRICS, bounds_s=bounds_s)) as endpoint:
        assert main(["--connect", endpoint, "--once", "--interval", "0.1"]) == 1
        assert "rows do not go with" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (("--map", "other"), 1, "no server has a map 'other'; available: default"),
        (("--map", "\x1b[2J"), 2, r"map name '\x1b[2J' is not allowed"),
        (("--config", "missing.json5"), 1, "missing.json5"),
    ],
)
def test_what_cannot_be_watched_is_said_in_one_line(endpoint, capsys, arguments, status, text):
    assert main(["--connect", endpoint, *arguments]) == status
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line
    assert line.isprintable()


def test_where_no_server_is_nothing_is_watched(capsys):
    assert main(["--connect", servers.free_endpoint()]) == 1
    assert "Start triquad-server there" in capsys.readouterr().err
    for wrong in (["--interval", "0"], ["--interval", "x"], ["--interval", "1e9"], ["--connect"]):
        with pytest.raises(SystemExit, match="2"):
            main(wrong)
