"""Questions about a shared map in parts: each row goes to the server of its place, and back."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from triquad_client.net.shared_places import SharedPlaces
from triquad_client.net.shared_questions import Part, joined, parts_of
from triquad_format.errors import RefusedError
from triquad_format.wire.messages import (
    FlushReply,
    FlushRequest,
    SdfReply,
    SdfRequest,
)
from triquad_format.wire.query_messages import (
    DistanceReply,
    DistanceRequest,
    RaysReply,
    RaysRequest,
)
from triquad_format.wire.shares import Shares, lease_key, share_key
from triquad_format.wire.source_messages import CorrectPosesRequest

SERVERS = [1, 2, 5]
PITCH_M = 10.0
X = st.lists(st.integers(-50, 50), max_size=40)


def tokens():
    """Servers by slabs of ten metres along x."""
    shares = Shares()
    for number in SERVERS:
        shares.add(share_key("town", number))
    for x in range(-20, 30):
        shares.add(lease_key("town", SERVERS[x % len(SERVERS)], (x, 0, 0), 0))
    return shares


PLACES = SharedPlaces(tokens(), PITCH_M)


def owners(points):
    return np.array(SERVERS)[np.floor(points[:, 0] / PITCH_M + 0.5).astype(int) % len(SERVERS)]


def places(x):
    return np.array([[along, 1.0, 2.0] for along in x], np.float32).reshape(-1, 3)


def asked(request):
    return parts_of(request, lambda: PLACES, SERVERS)


def answered(part):
    """The reply of a server, by which each row can be told."""
    rows = part.request.points
    return SdfReply(part.number, rows[:, 0] + part.number / 8, rows[:, 0].astype(np.uint8), None)


def distances(part, off_m, unknown_m, surface_x):
    """A reply in which a server knows a surface at some place and distance from all points."""
    count = len(part.rows)
    assert part.request.surface_point or len(set(part.owned.tolist())) < 2
    return DistanceReply(
        epoch=0,
        distance_m=np.full(count, off_m, np.float32),
        gradient=np.full((count, 3), part.number, np.float32),
        found=np.full(count, abs(off_m) < 5.0, np.uint8),
        status=np.full(count, part.number % 3, np.uint8),
        confidence=np.ones(count, np.float32),
        surface_point=np.tile(np.float32([surface_x, 0, 0]), (count, 1)),
        unknown_distance_m=np.full(count, unknown_m, np.float32),
        unknown_point=np.full((count, 3), part.number, np.float32),
    )


@given(X)
def test_each_row_is_answered_by_its_server_and_stays_in_its_place(x):
    origin = np.array([100.0, 0.0, 0.0])
    request = SdfRequest(origin, places(x), False, 0)
    parts = asked(request)
    assert sum(len(part.request.points) for part in parts) == len(x)
    reply = joined(parts, [answered(part) for part in parts], {"epoch": 7}, lambda: PLACES)
    expected = owners(places(x) + origin)
    assert reply.epoch == 7
    assert reply.gradient is None
    assert np.array_equal(reply.sdf, np.array(x) + expected / 8)


def test_a_question_without_rows_goes_to_all():
    parts = asked(SdfRequest(np.zeros(3), places([]), False, 0))
    assert [part.number for part in parts] == SERVERS


@given(X)
def test_rays_keep_their_directions(x):
    ways = np.eye(3, dtype=np.float32)[np.arange(len(x)) % 3]
    request = RaysRequest(np.zeros(3), places(x), ways, 5.0, False, 0)
    parts = asked(request)
    replies = [
        RaysReply(
            0, one.request.directions @ np.float32([1, 2, 3]), np.zeros(len(one.rows), np.uint8)
        )
        for one in parts
    ]
    reply = joined(parts, replies, {}, lambda: PLACES)
    assert np.array_equal(reply.range_m, ways @ np.float32([1, 2, 3]))


@given(X)
def test_distances_near_a_border_are_asked_of_both(x):
    request = DistanceRequest(np.zeros(3), places(x), 4.0, False, True, 0)
    parts = asked(request)
    rows = sorted(row for part in parts for row in part.rows.tolist())
    near = [abs((along + 5) % 10 - 5) > 1 for along in x]  # less than 4 m from a border
    edge = [(along + 5) % 10 in (4, 6) for along in x]
    twice = np.bincount(rows, minlength=len(x)) == 2 if x else []
    for is_twice, is_near, at_edge in zip(twice, near, edge, strict=True):
        assert is_twice == is_near or at_edge
    off_m = {1: 3.0, 2: -2.0, 5: 1.0}
    unknown_m = {1: 1.0, 2: 3.0, 5: 2.0}
    surface_x = {1: 0.0, 2: 10.0, 5: 0.0}  # of 5 it lies in a region of 1: it may be no more
    replies = [
        distances(p, off_m[p.number], unknown_m[p.number], surface_x[p.number]) for p in parts
    ]
    reply = joined(parts, replies, {}, lambda: PLACES)
    for row, owner in enumerate(owners(places(x)).tolist()):
        told = [part.number for part in parts if row in part.rows]
        counting = [number for number in told if number != 5 or owner == 5]
        nearest = min(counting, key=lambda number: (abs(off_m[number]), number != owner))
        assert (reply.distance_m[row], reply.gradient[row, 0]) == (off_m[nearest], nearest)
        assert reply.status[row] == owner % 3
        assert (reply.unknown_distance_m[row], reply.unknown_point[row, 0]) == (
            (unknown_m[owner], owner)
        )


@pytest.mark.parametrize(
    ("of_each", "expected"),
    [
        ([(5, 0, 0), (5, 0, 0)], (5, 0, 0)),
        ([(3, 2, 0), (5, 0, 0)], (3, 2, 0)),  # one could not use two of them
        ([(4, 0, 1), (5, 0, 0)], (4, 0, 1)),  # one lost a scan from its queue
        ([(2, 0, 0), (5, 0, 0)], (5, 0, 0)),  # one was started amid it
        ([(0, 0, 5), (5, 0, 0)], (5, 0, 0)),  # one was started afterwards
        ([(0, 0, 5), (0, 0, 5)], (0, 0, 5)),  # none arrived anywhere
    ],
)
def test_what_became_of_scans(of_each, expected):
    parts = [Part(n, FlushRequest("roof", 1, 4, 9.0)) for n in range(1, len(of_each) + 1)]
    replies = [FlushReply(True, *counts, None) for counts in of_each]
    reply = joined(parts, replies, {}, lambda: PLACES)
    assert reply.done
    assert (reply.taken, reply.refused, reply.lost) == expected
    assert not joined(parts, [replies[0], replace(replies[1], done=False)], {}, lambda: PLACES).done


def test_what_no_shared_map_can_do_is_refused():
    request = CorrectPosesRequest(
        "roof", np.array([1]), np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]), onward=False
    )
    with pytest.raises(RefusedError, match="correct_poses is not for a map that several servers"):
        asked(request)
