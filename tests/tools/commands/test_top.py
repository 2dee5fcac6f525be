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
from random import Random
from typing import Any

import numpy as np
import pytest
import triquad_client
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from support import servers
from support.server_records import METRICS, STATUS, later, operation
from support.terminal import Terminal, terminal
from triquad_client import Client, ServerMetrics, ServerStatus
from triquad_format.wire.metrics_messages import QueueMetrics, SourceMetrics
from triquad_server.settings.loading import load_settings
from triquad_tools.commands.top import main
from triquad_tools.console.amounts import count, duration, millimetres, rate, size
from triquad_tools.work.top import Sample, page

CODE = "import sys; from triquad_tools.commands.entry_points import top; sys.exit(top())"
CAUSE = "source 'camera': range_min_m = 1.5 drops 12 % of its points: set scan.range_min_m to less"
ROOMY = load_settings(servers.SMALL_FILE, ["memory.max_bytes=16_000_000_000"])
"""For the process of the tests, in which other tests may have left much."""
COUNTS = st.integers(0, 10**12)
EXTREMES: dict[type, tuple[Any, ...]] = {
    bool: (True, False),
    int: (-(2**63), -1, 0, 1, 2**63 - 1),
    float: (float("nan"), float("inf"), -1.0, 0.0, 1e-300, 1e308),
    str: ("", "\x1b[2J", "x" * 500, "\n\n", "\ud800"),
}


@given(before=COUNTS, more=COUNTS, seconds=st.floats(1e-3, 1e4))
def test_a_rate_times_its_interval_is_what_was_counted(before, more, seconds):
    first = {"scans_taken": before, "points_dropped": {"too_near": before, "forgotten": 9}}
    counts = {"too_near": before + more, "new": more, "forgotten": 5}
    second = {"scans_taken": before + more, "points_dropped": counts}
    per_s = between(later(0.0, first), later(seconds, second)).per_s
    counted = {name: number * seconds for name, number in per_s.items()}
    assert counted["scans taken"] == pytest.approx(more, rel=1e-5)
    for reason, number in (("too_near", more), ("new", more), ("forgotten", 0.0)):
        assert counted[f"points dropped: {reason}"] == pytest.approx(number, rel=1e-5)


def test_there_are_no_rates_without_a_time_and_of_a_restarted_server():
    for seconds in (float("nan"), float("inf"), 0.0, -1.0):
        assert between(later(0.0), later(seconds)).per_s == {}
    restarted = later(1.0, {"server": "second", "scans_taken": 5}, {"server": "second"})
    restarted = between(later(0.0), restarted)
    assert restarted.per_s == {}
    after = later(2.0, {"server": "second", "scans_taken": 15}, {"server": "second"})
    assert between(restarted, after).per_s["scans taken"] == pytest.approx(10.0)


def between(before: Sample, after: Sample) -> Sample:
    """The later sample, as it comes after the earlier one."""
    return before.after(after.status, after.metrics)


def drawn(
    status: dict[str, Any] | None = None, metrics: dict[str, Any] | None = None, width: int = 80
) -> str:
    """The page of a second in which this changed, no line longer than it is wide."""
    return text_of(between(later(0.0), later(1.0, status, metrics)), width)


def text_of(sample: Sample, width: int) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(page("map default at tcp/robot:7447", sample))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= width
    return text


@pytest.mark.parametrize("width", [80, 140])
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
        r"scans taken +12\.4 k +10\.0|samples trained +1\.24 G +812 k|samples left +3\.10 M|"
        r"epoch +1,236, 0\.4 s old|query/distance +123 +24\.0 +55\.0 +99\.1|"
        r"queue of scans +3 of 10|memory of process +612 MB|last checkpoint +epoch 1,200, 32 s ago"
        r"|kept scans +412 MB since 1000000000\.500 s|"
        r"source camera +heard 0\.2 s ago|points dropped: too_near +5,000 +0"
    )
    assert [line for line in lines.split("|") if not re.search(line, text)] == []
    assert "up 3 h 12 min" in " ".join(text.split())
    assert "!!" not in text  # what went wrong earlier is counted, and no more


@pytest.mark.parametrize(
    ("status", "metrics", "text"),
    [
        ({}, {"problem": "mapping makes no progress"}, "mapping makes no progress"),
        ({}, {"queues": {"scans": QueueMetrics(10, 10)}}, "the queue of scans is full"),
        ({"memory_bytes": 95, "map_max_bytes": 100}, {}, "memory nears 100 B"),
        ({"warnings": (CAUSE,)}, {}, CAUSE[:60]),
        ({"scans_dropped": {"empty": 2}}, {}, "scans refused: empty, 2.00 a second"),
        ({"scans_lost": {"roof": 3, "camera": 12}}, {}, "scans lost of: roof, 3.00 a second"),
        (
            {},
            {"sources": {**METRICS.sources, "camera": SourceMetrics(1, 345, 0, 12, 9.0)}},
            "source camera is silent for 9.0 s",
        ),
        (
            {},
            {"operations": {"query/sdf": operation([0.1], refused={"busy": 1})}},
            "query/sdf: busy, 1.00 requests a second are refused",
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


@given(st.randoms(use_true_random=False), st.sampled_from([20, 80, 140]))
def test_whatever_a_server_says_can_be_drawn_and_steers_no_terminal(random, width):
    before, after = (
        Sample(replace(scrambled(STATUS, random), server="x"), scrambled(METRICS, random))
        for _ in range(2)
    )
    text = text_of(replace(between(before, after), silent="\x1b[2J"), width)
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
    with servers.running_service(ROOMY, store=tmp_path_factory.mktemp("store")) as endpoint:
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
    for positive in ("scans taken", "query/distance", "query/flush", "memory of process"):
        assert re.search(rf"{positive} +\d*\.?\d*[1-9]", text), positive
    assert re.search(r"last checkpoint +epoch \d+, \d+\.\d s ago", text)
    (line,) = capsys.readouterr().out.splitlines()
    report = json.loads(line)
    assert (report["endpoint"], report["map"], report["silent"]) == (endpoint, "default", None)
    assert set(report["status"]) == {field.name for field in fields(ServerStatus)}
    assert set(report["metrics"]) == {field.name for field in fields(ServerMetrics)}
    assert report["per_s"]["scans taken"] > 0.0
    assert report["problems"] == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_page_is_drawn_again_until_it_ends_and_the_terminal_is_given_back(endpoint, number):
    with streaming(endpoint), top(endpoint) as opened:
        opened.wait_for(r"scans taken +\S.* [1-9]\d*\.\d")
        os.kill(opened.process, number)
        assert opened.wait() == 130
        assert "\x1b[?1049l" in opened.shown  # back on the screen of the shell
        assert "Traceback" not in opened.shown


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


def test_a_server_that_is_killed_and_started_again_is_noticed() -> None:
    arguments = ["--settings", servers.SMALL_FILE]
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
        lines_of(server.endpoint) as reports,
        top(server.endpoint) as opened,
    ):
        servers.learn(client)
        first = next(report for report in reports if report["per_s"])
        opened.wait_for(r"scans taken +2\b")
        server.process.kill()
        server.wait()
        silent = next(report for report in reports if report["silent"])
        assert silent["status"] is silent["per_s"] is None
        assert "the link to the server is down" in silent["silent"]
        assert re.search(r"scans taken +2\b", opened.wait_for("!! no answer for "))
        with servers.server_process(arguments, server.endpoint):
            back = next(report for report in reports if report["status"])
            assert back["per_s"] == {}
            assert back["status"]["server"] != first["status"]["server"]
            after = next(report for report in reports if report["per_s"])
            assert after["per_s"]["scans taken"] == 0.0
            opened.wait_for(r"(?s)^(?!.*no answer).*samples left")


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
