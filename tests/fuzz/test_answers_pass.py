"""No client refuses what a real map answers, whatever it is asked.

Clients check every reply against the question; a check that is too strict, or an answer that leaves
its documented bounds, would cost an honest robot its answer.
"""

from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.maps import small_world
from triquad_format.wire import codec
from triquad_format.wire.bounds import check_answers
from triquad_format.wire.messages import SdfRequest
from triquad_format.wire.query_messages import (
    AlignRequest,
    DistanceRequest,
    GridRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
    SpheresRequest,
)
from triquad_map.questions.answers import Answers

_POINTS = 60
_LENGTHS_M = st.floats(1e-3, 100.0)


@pytest.fixture(scope="module")
def answers():
    """Of a settled street."""
    world = small_world.world()
    epoch = small_world.settled_epoch()
    with pytest.MonkeyPatch.context() as patched:
        for limit in ("MAX_QUERY_POINTS", "MAX_SEARCHES"):
            patched.setattr(f"triquad_map.questions.answers.{limit}", 10**6)
        yield Answers(lambda _: nullcontext(epoch)), world.hits


def near_the_surface(rng, hits):
    """Points [N, 3] on, just beside and far from the surface, relative to an origin."""
    points = hits[rng.integers(0, len(hits), _POINTS)]
    spread = 10.0 ** rng.uniform(-4, 1.5, (_POINTS, 1))
    points = points + spread * rng.normal(size=points.shape)
    origin = points.mean(axis=0)
    return origin, (points - origin).astype(np.float32)


def questions(rng, hits, length_m):
    origin, points = near_the_surface(rng, hits)
    yield SdfRequest(origin, points, gradient=True, epoch=0)
    yield DistanceRequest(origin, points, length_m, True, True, 0)
    yield GroundRequest(origin, points, length_m, 0)
    radii = rng.uniform(0, min(length_m, 20.0), len(points)).astype(np.float32)
    yield SpheresRequest(origin, points, radii, 0)
    ends = points + rng.normal(0, 2, points.shape).astype(np.float32)
    yield SegmentsRequest(origin, points, ends, 0.3, min(max(length_m, 0.3), 10.0), 0)
    directions = rng.normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for through in (False, True):
        yield RaysRequest(origin, points, directions.astype(np.float32), length_m, through, 0)
    yield GridRequest(
        origin, float(rng.uniform(0.01, 0.5)), np.array([5, 4, 3], np.int32), length_m, 0
    )
    yield AlignRequest(points, np.eye(4), min(length_m, 5.0), 0)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), length_m=_LENGTHS_M)
def test_no_answer_of_a_real_map_is_refused(answers, seed, length_m):
    map_answers, hits = answers
    for question in questions(np.random.default_rng(seed), hits, length_m):
        asked = codec.decode(type(question), codec.encode(question))
        reply = map_answers.answer(asked)
        check_answers(asked, codec.decode(type(reply), codec.encode(reply)))
