"""Quantiles of times that were only counted in buckets."""

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.server_records import METRICS
from triquad_format.wire.metrics_messages import OperationMetrics, TimeHistogram

BOUNDS_S = np.array([0.001, 0.01, 0.1, 1.0])
OPERATION = "query/sdf"


def metrics(times_s, server="s"):
    counts = np.bincount(np.searchsorted(BOUNDS_S, times_s), minlength=5).astype(np.int64)
    answers = TimeHistogram(counts, float(sum(times_s)))
    operation = OperationMetrics(answers, answers, {"busy": 1}, 1, 10, 20)
    return replace(METRICS, server=server, bounds_s=BOUNDS_S, operations={OPERATION: operation})


@given(st.lists(st.floats(0, 0.99), min_size=1, max_size=50), st.sampled_from([0.0, 0.5, 0.99, 1]))
def test_a_quantile_lies_in_the_bucket_of_the_true_one(times_s, share):
    told_s = metrics(times_s).answer_time_s(OPERATION, share)
    ordered = sorted(times_s)
    true_s = ordered[max(0, math.ceil(share * len(ordered)) - 1)]
    bucket = np.searchsorted(BOUNDS_S, true_s)
    assert (0, *BOUNDS_S)[bucket] <= told_s <= BOUNDS_S[bucket]


def test_what_took_longer_than_all_bounds_is_told_as_such():
    slow = metrics([0.5, 100.0])
    assert slow.answer_time_s(OPERATION, 0.99) == math.inf
    assert slow.answer_time_s(OPERATION, 0.4) < 1.0


def test_differences_are_taken_within_one_server_alone():
    before, now = metrics([0.0005] * 9), metrics([0.0005] * 9 + [0.5])
    assert now.answer_time_s(OPERATION, 0.5) < 0.001
    assert now.answer_time_s(OPERATION, 0.5, since=before) > 0.1
    assert now.answer_time_s(OPERATION, 0.5, since=now) is None
    restarted = metrics([0.05], server="another")
    assert 0.01 < restarted.answer_time_s(OPERATION, 0.5, since=now) <= 0.1
