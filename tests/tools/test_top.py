"""``triquad-top``: rates of two samples, the page drawn of them, and the command at servers."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import triquad_client
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from support import servers
from support.server_records import METRICS, STATUS, later, operation
from support.terminal import Terminal, terminal
from triquad_client import Client, ServerMetrics, ServerStatus
from triquad_format.wire.metrics_messages import QueueMetrics, SourceMetrics
from triquad_tools.commands.top import main
from triquad_tools.console.amounts import count, duration, millimetres, rate, size
from triquad_tools.top.interval import Sample, rates
from triquad_tools.top.page import Seen, page

CODE = "import sys; from triquad_tools.commands.entry_points import top; sys.exit(top())"
CAUSE = "source 'camera': range_min_m = 1.5 drops 12 % of its points: set scan.range_min_m to less"
COUNTS = st.integers(0, 10**12)
EXTREMES: dict[type, tuple[Any, ...]] = {
    bool: (True, False),
    int: (-(2**63), -1, 0, 1, 2**63 - 1),
    float: (float("nan"), float("inf"), -1.0, 0.0, 1e-300, 1e308),
    str: ("", "\x1b[2J", "x" * 500, "\n\n", "\ud800"),
}


@settings(deadline=None)
@given(before=COUNTS, more=COUNTS, seconds=st.floats(1e-3, 1e4))
def test_a_rate_times_its_interval_is_what_was_counted(before, more, seconds):
    first = {"scans_taken": before, "points_dropped": {"too_near": before, "forgotten": 9}}
    counts = {"too_near": before + more, "new": more, "forgotten": 5}
    second = {"scans_taken": before + more, "points_dropped": counts}
    seen = rates(later(0.0, first), later(seconds, second))
    assert seen is not None
    assert seen.seconds == pytest.approx(seconds, rel=1e-6, abs=1e-6)
    assert seen.scans_taken * seen.seconds == pytest.approx(more)
    dropped = {name: per_s * seen.seconds for name, per_s in seen.points_dropped.items()}
    assert dropped == pytest.approx({"too_near": more, "new": more, "forgotten": 0.0})


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), 0.0, -1.0])
def test_there_are_no_rates_without_a_time_and_of_a_restarted_server(seconds):
    assert rates(later(0.0), later(seconds)) is None
    restarted = later(1.0, {"server": "second", "scans_taken": 5}, {"server": "second"})
    assert rates(later(0.0), restarted) is None
    after = rates(restarted, later(2.0, {"server": "second", "scans_taken": 15}))
    assert after is not None
    assert after.scans_taken == pytest.approx(10.0)


def drawn(
    status: dict[str, Any] | None = None, metrics: dict[str, Any] | None = None, width: int = 80
) -> str:
    """The page of a second in which this changed, no line longer than it is wide."""
    samples = later(0.0), later(1.0, status, metrics)
    return text_of(Seen(samples[1], rates(*samples)), width)


def text_of(seen: Seen, width: int) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(page("map default at tcp/robot:7447", seen, width))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= width
    return text


@pytest.mark.parametrize("width", [40, 80, 140])
def test_the_page_tells_rates_counts_and_times_on_any_width(width):
    text = drawn(
        {"scans_taken": 12_355, "samples_trained": 1_240_812_000, "epoch": 1236},
        {
            "operations": {"query/distance": operation([0.004] * 99 + [0.04] * 24)},
            "scan_bytes_received": 8_008_200_000,
        },
        width,
    )
    lines = (
        r"taken +10\.0 +12\.4 k|bytes received +8\.20 MB +8\.01 GB|samples /s +812 k|"
        r"samples left +3\.10 M, 3\.8 s|epoch +1,236, 0\.4 s old|distance +24\.0 +55\.0 +99\.1|"
        r"scans +3 +10|evidence +120 MB|last checkpoint +epoch 1,200, 32 s ago|client +2|"
        r"camera +0 +12 +0\.2 s ago|too_near +0 +5,000"
    )
    assert [line for line in lines.split("|") if not re.search(line, text)] == []
    assert "up 3 h 12 min" in " ".join(text.split())
    assert "!!" not in text  # what went wrong earlier is counted, and no more


@pytest.mark.parametrize(
    ("status", "metrics", "text"),
    [
        ({}, {"problem": "mapping makes no progress"}, "mapping makes no progress"),
        ({}, {"queues": {"scans": QueueMetrics(10, 10)}}, "the queue of scans is full"),
        ({}, {"epoch_age_s": 12.0}, "no new epoch for 12 s"),
        ({"map_bytes": 95, "map_max_bytes": 100}, {}, "the map nears 100 B"),
        ({"warnings": CAUSE}, {}, CAUSE[:60]),
        ({"scans_dropped": {"empty": 2}}, {}, "2.00 scans a second are refused: empty"),
        ({}, {"sources": {"roof": SourceMetrics(1, 12_000, 0, 3, 0.1)}}, "source roof: 3.00 scans"),
        (
            {},
            {"sources": {**METRICS.sources, "camera": SourceMetrics(1, 345, 0, 12, 9.0)}},
            "source camera is silent for 9.0 s",
        ),
        (
            {},
            {"operations": {"query/sdf": operation([0.1], refused={"busy": 1})}},
            "query/sdf: busy: 1.00 requests a second are refused",
        ),
    ],
)
def test_what_is_out_of_order_is_told_at_the_top(status, metrics, text):
    assert f"!! {text}" in drawn(status, metrics, 100).splitlines()[1]


def scrambled(value: Any, random: Random) -> Any:
    """A record like this one with extreme values, some of them as they were."""
    if isinstance(value, np.ndarray):
        return random.choice((value, -value, np.full_like(value, 0)))
    if is_dataclass(value):
        changed = {field.name: getattr(value, field.name) for field in fields(value)}
        return replace(value, **{k: scrambled(v, random) for k, v in changed.items()})
    if isinstance(value, dict):
        return {scrambled(k, random): scrambled(v, random) for k, v in value.items()}
    return random.choice((value, *EXTREMES.get(type(value), ())))


@settings(deadline=None)
@given(st.randoms(use_true_random=False), st.sampled_from([20, 80, 140]))
def test_whatever_a_server_says_can_be_drawn_and_steers_no_terminal(random, width):
    before, after = (
        Sample(replace(scrambled(STATUS, random), server="x"), scrambled(METRICS, random))
        for _ in range(2)
    )
    text = text_of(Seen(after, rates(before, after), silent="\x1b[2J"), width)
    assert text.replace("\n", "").isprintable()


def test_amounts_have_three_digits_and_a_unit():
    assert [count(9999), count(999_999)] == ["9,999", "1.00 M"]
    assert [rate(0.001), rate(9.996)] == ["<0.01", "10.0"]
    assert [size(0), size(1_240_000_000), millimetres(0.0123)] == ["0 B", "1.24 GB", "12.3 mm"]
    times = [duration(seconds) for seconds in (0.04, 59.7, 90_000.0, float("inf"))]
    assert times == ["0.0 s", "1 min 0 s", "1 d 1 h", "inf"]


@pytest.fixture(autouse=True)
def no_width_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests that run in parallel are told of a terminal of 80 columns, which is not there."""
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
def top(endpoint: str) -> Iterator[Terminal]:
    with terminal(CODE, "--connect", endpoint, "--interval", "0.2", environment={}) as opened:
        yield opened


def test_once_is_the_whole_page_as_text_or_json(endpoint, capsys):
    with streaming(endpoint) as client:
        client.checkpoint()
        assert main(["--connect", endpoint, "--once", "--interval", "2"]) == 0
        text = capsys.readouterr().out
        assert main(["--connect", endpoint, "--once", "--json", "--interval", "0.5"]) == 0
    assert text.replace("\n", "").isprintable()
    assert max(map(len, text.splitlines())) <= 100
    assert text.startswith(f"map default at {endpoint}, triquad ")
    for positive in ("taken", "roof", "distance", "flush", "epochs /s", "process", "client"):
        assert re.search(rf"{positive} +\d*\.?\d*[1-9]", text), positive
    assert re.search(r"last checkpoint +epoch \d+, \d+\.\d s ago", text)
    (line,) = capsys.readouterr().out.splitlines()
    report = json.loads(line)
    assert (report["endpoint"], report["map"], report["silent"]) == (endpoint, "default", None)
    assert set(report["status"]) == {field.name for field in fields(ServerStatus)}
    assert set(report["metrics"]) == {field.name for field in fields(ServerMetrics)}
    assert report["rates"]["scans_taken"] > 0.0
    assert 0.0 < report["rates"]["p50_s"]["query/distance"] < servers.WAIT_S
    assert (report["problems"], report["restarted"]) == ([], False)


@pytest.mark.parametrize(("typed", "status"), [(b"xq", 0), (b"\x03", 130), (None, 130)])
def test_the_page_is_drawn_again_until_it_ends_and_the_terminal_is_given_back(
    endpoint, typed, status
):
    with streaming(endpoint), top(endpoint) as opened:
        modes = opened.modes
        opened.wait_for(r"taken +[1-9]\d*\.\d")
        assert opened.modes != modes  # what is typed is not shown
        if typed is None:
            os.kill(opened.process, signal.SIGTERM)
        else:
            opened.type(typed)
        assert opened.wait() == status
        assert "\x1b[?1049l" in opened.shown  # back on the screen of the shell
        assert "Traceback" not in opened.shown
        assert opened.modes == modes


@contextmanager
def lines_of(endpoint: str) -> Iterator[Iterator[dict[str, Any]]]:
    """What ``--json`` prints, until it is interrupted."""
    line = [sys.executable, "-c", CODE, "--connect", endpoint, "--json", "--interval", "0.2"]
    pipe = subprocess.PIPE
    with subprocess.Popen(line, stdout=pipe, stderr=pipe, text=True) as process:
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
        assert "the link to the server is down" in silent["silent"]
        assert re.search(r"taken +\S+ +2\b", opened.wait_for("!! no answer for "))
        with servers.server_process(arguments, server.endpoint):
            back = next(report for report in reports if report["status"])
            assert (back["restarted"], back["rates"]) == (True, None)
            assert back["status"]["server"] != first["status"]["server"]
            after = next(report for report in reports if report["rates"])
            assert after["rates"]["scans_taken"] == 0.0
            assert "no answer" not in opened.wait_for(r"taken +0 +0\b")


def test_what_cannot_be_watched_is_said_in_one_line(endpoint, capsys):
    cases = {
        "other": (1, "available: default"),
        "\x1b[2J": (2, r"map name '\x1b[2J' is not allowed"),
    }
    for name, (status, text) in cases.items():
        assert main(["--connect", endpoint, "--map", name]) == status
        (line,) = capsys.readouterr().err.splitlines()
        assert text in line
        assert line.isprintable()
    for wrong in ("0", "x"):
        with pytest.raises(SystemExit, match="2"):
            main(["--interval", wrong])
