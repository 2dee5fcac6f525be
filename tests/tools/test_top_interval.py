"""What happened between two looks at a server."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.server_records import BOUNDS_S, METRICS, STATUS, later, operation, sample
from triquad_format.wire.metrics_messages import SourceMetrics
from triquad_tools.top.interval import interval
from triquad_tools.top.problems import Grade, problems

COUNTS = st.integers(0, 10**12)
SECONDS = st.floats(1e-3, 1e4)
TIMES_S = st.lists(st.floats(1e-4, 9.9), min_size=1, max_size=200)


@settings(deadline=None)
@given(before=COUNTS, more=COUNTS, seconds=SECONDS)
def test_a_rate_times_its_interval_is_what_was_counted(before, more, seconds):
    first = later(0.0, {"scans_taken": before, "points_dropped": {"too_near": before}})
    counts = {
        "scans_taken": before + more,
        "points_dropped": {"too_near": before + more, "new": more},
    }
    seen = interval(first, later(seconds, counts))
    assert seen.seconds == pytest.approx(seconds, rel=1e-6, abs=1e-6)
    assert seen.rates is not None
    assert seen.rates.scans_taken * seen.seconds == pytest.approx(more)
    assert seen.rates.points_dropped["too_near"] * seen.seconds == pytest.approx(more)
    assert seen.rates.points_dropped["new"] * seen.seconds == pytest.approx(more)


@settings(deadline=None)
@given(before=TIMES_S, during=TIMES_S)
def test_quantiles_are_those_of_the_interval_alone(before, during):
    first = later(0.0, metrics={"operations": {"query/sdf": operation(before)}})
    second = later(2.0, metrics={"operations": {"query/sdf": operation(before + during)}})
    seen = interval(first, second)
    assert seen.traffic is not None
    sdf = seen.traffic.operations["query/sdf"]
    assert sdf.answered == pytest.approx(len(during) / 2.0)
    assert seen.traffic.requests_answered == pytest.approx(sdf.answered)
    edges = np.concatenate([[0.0], BOUNDS_S])
    for shown_s, share in ((sdf.p50_s, 0.5), (sdf.p99_s, 0.99)):
        true_s = np.quantile(during, share, method="inverted_cdf")
        bucket = int(np.searchsorted(BOUNDS_S, true_s))
        low_s, high_s = edges[bucket], edges[bucket + 1]  # as near as a histogram tells
        assert low_s * (1.0 - 1e-9) <= shown_s <= high_s * (1.0 + 1e-9)
    assert sdf.p50_s <= sdf.p99_s


@settings(deadline=None)
@given(counts=st.dictionaries(st.sampled_from(["a", "b", "*"]), COUNTS))
def test_no_rate_is_negative(counts):
    lost = {"scans_lost": {"a": 5, "b": 7, "c": 9}}
    seen = interval(later(0.0, lost), later(1.0, {"scans_lost": counts}))
    assert seen.rates is not None
    assert all(rate >= 0.0 for rate in seen.rates.scans_lost.values())


def test_a_restarted_server_has_no_rates_but_those_after():
    new = {"server": "second", "scans_taken": 5}
    restarted = interval(later(0.0), later(-11_000.0, new, {"server": "second"}))
    assert restarted.restarted
    assert (restarted.seconds, restarted.rates, restarted.traffic) == (None, None, None)
    assert [problem.grade for problem in problems(restarted)] == [Grade.WARNING]
    going_on = {"server": "second", "scans_taken": 15}
    after = interval(restarted.sample, later(-10_999.0, going_on, {"server": "second"}))
    assert not after.restarted
    assert after.rates is not None
    assert after.rates.scans_taken == pytest.approx(10.0)


@pytest.mark.parametrize("uptime_s", [math.nan, math.inf, 0.0, STATUS.uptime_s])
def test_without_a_time_between_them_there_are_no_rates(uptime_s):
    second = sample(replace(STATUS, uptime_s=uptime_s), replace(METRICS, uptime_s=uptime_s))
    seen = interval(sample(), second)
    assert (seen.seconds, seen.rates, seen.traffic) == (None, None, None)


def test_sources_and_the_mapper_have_rates():
    sources = {"roof": SourceMetrics(1, 12_020, 4, 2, 0.1), "new": SourceMetrics(1, 6, 0, 0, 0.1)}
    changes = {"sources": sources, "mapper_s": {"train": 8001.0, "idle": 3000.5}}
    traffic = interval(later(0.0), later(2.0, metrics=changes)).traffic
    assert traffic is not None
    roof = traffic.sources["roof"]
    assert (roof.taken, roof.refused, roof.lost) == (10.0, 2.0, 1.0)
    assert traffic.sources["new"].taken == 3.0
    assert traffic.mapper_share == {"train": 0.5, "idle": 0.25}


def test_an_older_server_has_what_its_status_tells():
    seen = interval(sample(metrics=None), sample(replace(STATUS, uptime_s=11_521.0), None))
    assert seen.rates is not None
    assert seen.traffic is None
    assert problems(seen) == ()
