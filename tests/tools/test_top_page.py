"""The page as people read it."""

import io
import json
import math
import re
import time
from dataclasses import fields, is_dataclass, replace
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from support.server_records import CHECKPOINT, METRICS, STATUS, later, operation, sample
from triquad_format.wire.metrics_messages import CheckpointMetrics, QueueMetrics, SourceMetrics
from triquad_tools.top.amounts import (
    count,
    duration,
    millimetres,
    milliseconds,
    rate,
    size,
    within,
)
from triquad_tools.top.interval import Interval, Sample, interval
from triquad_tools.top.page import Page
from triquad_tools.top.report import json_line
from triquad_tools.top.watch import Silence, Target

TARGET = Target("tcp/robot:7447", "default")
CAUSE = "source 'camera': range_min_m = 1.5 drops 12 % of its points: set scan.range_min_m to less"


def seen(status: dict[str, Any] | None = None, metrics: dict[str, Any] | None = None) -> Interval:
    """A second in which this changed."""
    return interval(later(0.0), later(1.0, status, metrics))


def drawn(page: Page | Interval, width: int = 80, height: int | None = None) -> list[str]:
    """The lines of a page, none of them longer than it is wide."""
    page = page if isinstance(page, Page) else Page(TARGET, page)
    console = Console(width=width, file=io.StringIO(), record=True, color_system=None)
    console.print(replace(page, height=height))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    assert height is None or len(lines) <= height
    return lines


def line_of(text: str, lines: list[str]) -> str:
    """The first line with this text."""
    return next(line for line in lines if text in line)


def test_the_page_tells_rates_counts_and_times():
    operations = {"query/distance": operation([0.004] * 99 + [0.04] * 24)}
    lines = drawn(
        seen(
            {"scans_taken": 12_355, "samples_trained": 1_240_812_000, "epoch": 1236},
            {"operations": operations, "scan_bytes_received": 8_008_200_000},
        ),
        width=140,
    )
    text = "\n".join(lines)
    assert lines[0].startswith("map default at tcp/robot:7447, triquad 0.1.0 on cpu, up 3 h 12 min")
    assert re.search(r"taken +10\.0 +12\.4 k", text)
    assert re.search(r"bytes received +8\.20 MB +8\.01 GB", text)
    assert re.search(r"samples /s +812 k", text)
    assert re.search(r"to learn +3\.10 M samples, 3\.8 s", text)
    assert re.search(r"epoch +1,236, 0\.4 s old", text)
    assert re.search(r"distance +24\.0 +55\.0 +99\.1", text)
    assert re.search(r"scans +3 +10", text)
    assert re.search(r"evidence +120 MB", text)
    assert re.search(r"last checkpoint +32 s ago", text)
    assert re.search(r"camera +0 +12 +0\.2 s ago", text)
    assert re.search(r"client +2", text)
    assert "!" not in text


@pytest.mark.parametrize("width", [40, 80, 140, 200])
def test_every_figure_is_there_on_any_width(width):
    text = "\n".join(drawn(seen(), width))
    for name in ("SCANS", "SOURCES", "POINTS DROPPED", "MAP", "STORE", "QUEUES", "MEMORY"):
        assert f" {name} " in text
    for name in ("taken", "roof", "too_near", "loss", "written", "distance", "field", "train"):
        assert name in text


@pytest.mark.parametrize("height", [3, 10, 20])
def test_a_low_terminal_shows_the_first_lines_and_says_that_there_are_more(height):
    lines = drawn(seen(), 80, height)
    assert "map default at " in lines[0]
    assert re.search(r"\d+ more lines: make the window larger, or use --once", lines[-1])
    assert len(lines) == height


def test_24_lines_are_enough_for_all_but_details():
    text = "\n".join(drawn(seen(), 80, 24))
    for name in ("SCANS", "SOURCES", "MAP", "STORE", "QUEUES", "OPERATIONS", "distance"):
        assert name in text


@pytest.mark.parametrize(
    ("status", "metrics", "sign", "text"),
    [
        ({}, {"problem": "mapping makes no progress"}, "!!", "mapping makes no progress"),
        ({}, {"queues": {"scans": QueueMetrics(10, 10)}}, "!!", "the queue of scans is full"),
        ({}, {"epoch_age_s": 12.0}, "!!", "no new epoch for 12 s"),
        ({"requests_refused": {"busy": 5}}, {}, "! ", "5.00 requests a second are refused"),
        ({"warnings": CAUSE}, {}, "! ", "source 'camera': range_min_m = 1.5 drops"),
        ({"scans_dropped": {"empty": 2}}, {}, "!!", "dropped, empty"),
        ({}, {"sources": {"roof": SourceMetrics(1, 12_000, 0, 3, 0.1)}}, "!!", "roof"),
        (
            {},
            {"sources": {**METRICS.sources, "camera": SourceMetrics(1, 345, 0, 12, 9.0)}},
            "! ",
            "camera",
        ),
        ({}, {"operations": {"query/sdf": operation([0.1], refused={"busy": 1})}}, "! ", "sdf"),
    ],
)
def test_what_is_out_of_order_has_a_sign(status, metrics, sign, text):
    assert f"{sign} {text}" in line_of(text, drawn(seen(status, metrics)))


def test_what_went_wrong_earlier_has_none():
    assert not [line for line in drawn(seen()) if "!" in line]


def test_a_store_that_fails_is_marked_and_one_that_never_was_is_not():
    failed = {"checkpoints": CheckpointMetrics(3, 2, 0.3, 900.0), "problem": "the store: disk full"}
    lines = drawn(seen({"store_error": "disk full"}, failed))
    assert "!! last checkpoint" in line_of("last checkpoint", lines)
    assert "3, 2 failed" in line_of("written", lines)
    none = {"checkpoints": CheckpointMetrics(0, 0, None, None)}
    lines = drawn(seen({"store_error": "started without a store", "last_checkpoint": None}, none))
    assert re.search(r"last checkpoint +none", "\n".join(lines))
    assert not [line for line in lines if "!" in line]


def test_the_age_of_a_restored_checkpoint_is_that_of_its_stamp():
    status = {"last_checkpoint": replace(CHECKPOINT, stamp_ns=time.time_ns() - 90 * 10**9)}
    restored = seen(status, {"checkpoints": CheckpointMetrics(0, 0, None, None)})
    assert "1 min 30 s ago" in line_of("last checkpoint", drawn(restored))


def test_warnings_are_told_in_full_and_folded():
    lines = drawn(seen({"warnings": f"{CAUSE}\nsource 'roof': loses scans"}), 50)
    folded = " ".join(line.strip("! ") for line in lines[1:6])
    assert folded.startswith(f"{CAUSE} source 'roof': loses scans")


def test_many_warnings_leave_room_for_the_figures():
    lines = drawn(seen({"warnings": "\n".join(f"cause {n}" for n in range(50))}), 80, 24)
    assert "more lines" in lines[11]
    assert "SCANS" in lines[12]


def test_a_settled_map_says_so():
    assert "nothing, settled" in line_of("to learn", drawn(seen({"settled": True})))


def test_a_server_that_is_silent_keeps_its_last_figures():
    silence = Silence(time.monotonic() - 75.0, "the link to the server is down")
    lines = drawn(Page(TARGET, seen(), silence))
    assert re.match(r"!! no answer since \d\d:\d\d:\d\d, for 1 min 15 s: the link to the", lines[1])
    assert any("taken" in line for line in lines)


def test_what_an_older_server_cannot_tell_is_said():
    older = interval(
        sample(metrics=None), Sample(1, replace(STATUS, uptime_s=11_521.0), None, "it is older")
    )
    text = "\n".join(drawn(older))
    assert "   it is older" in text
    assert re.search(r"lost, camera +0 +12", text)
    assert re.search(r"whole process +612 MB", text)
    assert "OPERATIONS" not in text


def test_text_of_the_network_does_not_reach_the_terminal_raw():
    evil = "\x1b]0;owned\x07\x9b2J\u202e[red]"
    status = {"warnings": evil, "version": evil, "device": evil, "scans_dropped": {evil: 1}}
    metrics = {
        "problem": evil,
        "sources": {evil: SourceMetrics(1, 1, 0, 0, 0.1)},
        "operations": {evil: operation([0.1], refused={evil: 1})},
        "queues": {evil: QueueMetrics(1, 10)},
        "memory_bytes": {evil: 1},
        "sessions": {"a": evil},
        "mapper_s": {evil: 1.0},
    }
    page = Page(Target("tcp/\x1b[1m", "map"), seen(status, metrics), None)
    text = "\n".join(drawn(page, 400))
    assert text.replace("\n", "").isprintable()
    assert text.count(r"\x1b]0;owned\x07\x9b2J\u202e[red]") >= 10
    assert drawn(Page(TARGET, None, Silence(0.0, evil)), 200)[1].isprintable()


EXTREMES: dict[type, tuple[Any, ...]] = {
    bool: (True, False),
    int: (-(2**63), -1, 0, 1, 2**63 - 1),
    float: (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e-300, 1e308),
    str: ("", "\x1b[2J", "x" * 500, "\n\n", "\ud800"),
}


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
def test_whatever_a_server_says_can_be_drawn(random, width):
    records = [
        sample(replace(scrambled(STATUS, random), server="x"), scrambled(METRICS, random))
        for _ in range(2)
    ]
    found = interval(*records)
    assert all(line.isprintable() for line in drawn(found, width))
    assert all(line.isprintable() for line in drawn(found, width, 24))
    json.loads(json_line(TARGET, found))


def test_colours_are_left_out_where_that_is_asked_for(monkeypatch):
    page = Page(TARGET, seen({"warnings": "cause"}))

    def output() -> str:
        file = io.StringIO()
        Console(file=file, force_terminal=True, width=80).print(page)
        return file.getvalue()

    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    assert "\x1b[1;33m" in output()
    monkeypatch.setenv("NO_COLOR", "1")
    assert not re.search(r"\x1b\[[0-9;]*3\d", output())
    assert re.search(r"!  .*cause", output())


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (count(9999), "9,999"),
        (count(999_999), "1.00 M"),
        (rate(0.001), "<0.01"),
        (rate(9.996), "10.0"),
        (rate(812_345.0), "812 k"),
        (size(0), "0 B"),
        (size(1_240_000_000), "1.24 GB"),
        (duration(0.04), "0.0 s"),
        (duration(59.7), "1 min 0 s"),
        (duration(90_000.0), "1 d 1 h"),
        (duration(float("inf")), "inf"),
        (milliseconds(0.00425), "4.25"),
        (millimetres(0.0123), "12.3 mm"),
        (within(0.00042, 0.00421), "0.42 mm, 90 % in 4.21 mm"),
    ],
)
def test_amounts_have_three_digits_and_a_unit(shown, text):
    assert shown == text
