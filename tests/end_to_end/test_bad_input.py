"""Whatever arrives, the server counts it, tells why, and goes on."""

import dataclasses
from collections import Counter

import msgpack
import numpy as np
import pytest
import triquad_client
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import servers
from support.operations import OPERATIONS
from triquad_format.wire import codec, keys
from triquad_format.wire.limits import MAX_SEQUENCE
from triquad_format.wire.mesh_messages import MeshRequest, TileListRequest
from triquad_format.wire.messages import FlushRequest, ResetRequest, SdfRequest
from triquad_format.wire.query_messages import (
    ChangesRequest,
    DistanceRequest,
    GroundRequest,
    RaysRequest,
    SegmentsRequest,
)
from triquad_format.wire.source_messages import SourcesRequest
from triquad_format.wire.status_messages import StatusRequest

ORIGIN = np.zeros(3)
ONE_POINT = np.zeros((1, 3), np.float32)
FAR_POINT = np.full((1, 3), 1e18, np.float32)


def segments(count, length_m):
    starts = np.zeros((count, 3), np.float32)
    ends = starts + np.array([length_m, 0, 0], np.float32)
    return SegmentsRequest(ORIGIN, starts, ends, 0.1, 5.0, 0)


def rays(count, range_m):
    ways = np.tile(np.array([1, 0, 0], np.float32), (count, 1))
    return RaysRequest(ORIGIN, np.zeros_like(ways), ways, range_m, False, 0)


def ground(count, drop_m, z=0.0):
    return GroundRequest(ORIGIN, np.full((count, 3), z, np.float32), drop_m, 0)


def flush(**changes):
    """A question about a scan that never came."""
    good = {"source": "lidar", "session": 7, "sequence": 0, "waited_s": 0.0}
    return FlushRequest(**(good | changes))


def tiles(*xs):
    """Tiles [T, 3] along the x axis."""
    return np.array([(x, 0, 0) for x in xs], np.int32).reshape(-1, 3)


@pytest.fixture
def peer(endpoint):
    with servers.raw_session(connect=endpoint) as session:
        yield servers.RawPeer(session)


@pytest.fixture(scope="module")
def asked():
    """A client and a raw peer of one server, of which all wrong things are asked."""
    with (
        servers.running_service() as endpoint,
        triquad_client.connect(endpoint) as client,
        servers.raw_session(connect=endpoint) as session,
    ):
        yield client, servers.RawPeer(session)


def changed(message, **changes):
    return msgpack.packb(msgpack.unpackb(codec.encode(message)) | changes)


GOOD = codec.encode(servers.scan())


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "decode"),
        (np.random.default_rng(0).bytes(10_000), "decode"),
        (GOOD[: len(GOOD) // 2], "decode"),
        (codec.encode(StatusRequest()), "decode"),
        (changed(servers.scan(), triquad=2), "bad_version"),
        (changed(servers.scan(), points=codec.pack_array(np.zeros((5, 2), np.float32))), "decode"),
        (changed(servers.scan(), source="radar"), "key_source_mismatch"),
        (changed(servers.scan(), sequence=-1), "bad_sequence"),
        (changed(servers.scan(), sequence=2**62), "bad_sequence"),
        (codec.encode(servers.scan(points=np.zeros((2_600_000, 3), np.float32))), "too_large"),
    ],
)
def test_scans_that_cannot_be_read_are_counted_by_reason(peer, client, payload, reason):
    peer.put("lidar", payload)
    # What one session sends stays in order: once this one is in, the bad one was looked at.
    peer.put("lidar", GOOD)
    assert peer.flush(servers.scan()).taken == 1
    status = client.status()
    assert status.scans_dropped == {reason: 1}
    assert status.scans_taken == 1
    assert not any(status.scans_lost.values())
    result = client.query_sdf(servers.sphere(20))
    assert (result.status == triquad_client.Status.SURFACE).all()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"world_from_sensor": np.zeros((4, 4))}, "pose_not_rigid"),
        ({"world_from_sensor": np.eye(4) + np.eye(4, k=3) * 1e9}, "outside_world"),
        ({"stamp_ns": -5}, "time_backwards"),
        ({"no_return": np.float32([[0, 0, 1], [0, 0, 0]])}, "bad_no_return"),
        ({"no_return": np.float32([[0, -np.inf, 0]])}, "bad_no_return"),
    ],
)
def test_scans_that_cannot_be_used_are_refused_with_the_cause(peer, client, changes, reason):
    peer.put("lidar", GOOD)
    peer.put("lidar", codec.encode(servers.scan(1, **changes)))
    reply = peer.flush(servers.scan(1))
    assert (reply.taken, reply.refused, reply.lost) == (1, 1, 0)
    assert "scan 1: " in reply.last_refusal
    assert client.status().scans_dropped == {reason: 1}
    peer.put("lidar", codec.encode(servers.scan(2)))
    assert peer.flush(servers.scan(2)).taken == 2


def test_a_source_whose_name_cannot_stand_in_a_key_is_refused(peer, client):
    name = "a" * 65
    key = f"triquad/{peer.map_name}/scan/{name}"
    peer.session.put(key, codec.encode(servers.scan(source=name)))
    peer.put("lidar", GOOD)
    peer.flush(servers.scan())
    status = client.status()
    assert status.scans_dropped == {"bad_source": 1}
    assert name not in status.scans_lost


def test_random_scans_are_dropped_or_taken_but_never_do_harm(peer, client):
    rng = np.random.default_rng(3)
    for _ in range(30):
        payload = bytearray(GOOD)
        for position in rng.integers(0, 200, 20):
            payload[position] = rng.integers(0, 256)
        peer.put("lidar", bytes(payload))
    last = servers.scan(source="last")
    peer.put("last", codec.encode(last))
    assert peer.flush(last).taken == 1
    status = client.status()
    assert sum(status.scans_dropped.values()) + status.scans_taken == 31


@pytest.mark.parametrize(
    ("operation", "request_", "code"),
    [
        (keys.SDF, b"", "bad_request"),
        (keys.SDF, b"\xc1\xff", "bad_request"),
        (keys.SDF, codec.encode(StatusRequest()), "bad_request"),
        (keys.SDF, changed(StatusRequest(), triquad=9), "bad_version"),
        (keys.SDF, SdfRequest(ORIGIN, ONE_POINT * np.nan, False, 0), "bad_request"),
        (keys.SDF, SdfRequest(ORIGIN + np.inf, ONE_POINT, False, 0), "bad_request"),
        (keys.SDF, SdfRequest(ORIGIN - 1.7e308, ONE_POINT, False, 0), "bad_request"),
        (keys.DISTANCE, DistanceRequest(ORIGIN, FAR_POINT, 1.0, False, False, 0), "bad_request"),
        (keys.SDF, SdfRequest(ORIGIN, ONE_POINT, False, -1), "epoch_gone"),
        (
            keys.SDF,
            SdfRequest(ORIGIN, np.zeros((900_000, 3), np.float32), False, 0),
            "too_large",
        ),
        *((operation, bytes(6_010_000), "too_large") for operation in OPERATIONS),
        (keys.SEGMENTS, segments(2_000, 900.0), "too_large"),
        (keys.SEGMENTS, segments(1, 1_001.0), "bad_request"),
        (keys.RAYS, rays(100_000, 1_000.0), "too_large"),
        (keys.GROUND, ground(1, 101.0), "bad_request"),
        (keys.GROUND, ground(1, np.nan), "bad_request"),
        (keys.GROUND, ground(1, 1.0, z=np.inf), "bad_request"),
        (keys.GROUND, ground(100_000, 100.0), "too_large"),
        (keys.MESH, MeshRequest(tiles(2**31 - 1), 0), "bad_request"),
        (keys.MESH, MeshRequest(tiles(0, -(2**31)), 0), "bad_request"),
        (keys.MESH, MeshRequest(tiles(0), 0, fill_m=float("nan")), "bad_request"),
        (keys.MESH, MeshRequest(tiles(0), 0, fill_m=1e9), "bad_request"),
        (keys.MESH, MeshRequest(tiles(0), 0, level=3), "bad_request"),
        (keys.MESH, MeshRequest(tiles(), 0), "bad_request"),
        (keys.MESH, MeshRequest(tiles(*range(65)), 0), "bad_request"),
        (keys.MESH, MeshRequest(tiles(0), 0, fill_m=1.0), "bad_request"),
        (keys.TILE_CHANGES, servers.tile_changes(minimum=np.full(3, np.nan)), "bad_request"),
        (keys.TILE_CHANGES, servers.tile_changes(level=7), "bad_request"),
        (keys.TILE_LIST, TileListRequest(ORIGIN + 1, ORIGIN, 0), "bad_request"),
        (keys.TILE_LIST, TileListRequest(ORIGIN * np.nan, ORIGIN, 0), "bad_request"),
        (keys.RESET, ResetRequest(ORIGIN, ORIGIN * np.nan), "bad_request"),
        (keys.RESET, ResetRequest(ORIGIN, ORIGIN - 1), "bad_request"),
        (keys.FLUSH, flush(sequence=-1), "bad_request"),
        (keys.FLUSH, flush(sequence=MAX_SEQUENCE + 1), "bad_request"),
        (keys.FLUSH, flush(sequence=2**63 - 1), "bad_request"),
        (keys.FLUSH, flush(source=""), "bad_request"),
        (keys.FLUSH, flush(source="a/b"), "bad_request"),
        (keys.FLUSH, flush(source="a" * 65), "bad_request"),
        (keys.FLUSH, flush(waited_s=np.nan), "bad_request"),
        (keys.FLUSH, flush(waited_s=-1.0), "bad_request"),
        (keys.SOURCES, SourcesRequest("", 0, -1), "bad_request"),
        (keys.SOURCES, SourcesRequest("", 0, 10_001), "bad_request"),
        (keys.CHANGES, ChangesRequest(-1, "", ORIGIN, ORIGIN), "bad_request"),
        (keys.CHANGES, ChangesRequest(2**62, "", ORIGIN, ORIGIN), "epoch_gone"),
        (keys.CHANGES, ChangesRequest(0, "x" * 10_000, ORIGIN, ORIGIN), "epoch_gone"),
        (keys.CHANGES, ChangesRequest(0, "", ORIGIN * np.nan, ORIGIN), "bad_request"),
        (keys.CHANGES, ChangesRequest(0, "", ORIGIN + 1, ORIGIN), "bad_request"),
        *((operation, b"\x00", "bad_request") for operation in OPERATIONS),
    ],
)
def test_bad_requests_are_refused_with_a_code(asked, operation, request_, code):
    client, peer = asked
    before = Counter(client.status().requests_refused)
    assert peer.refusal(operation, request_) == code
    assert Counter(client.status().requests_refused) - before == {code: 1}
    assert len(client.query_sdf(ONE_POINT).status) == 1


def test_a_request_without_payload_is_refused(asked):
    _, peer = asked
    for operation in OPERATIONS:
        assert peer.ask(operation, None).code == "bad_request"


def test_a_request_for_another_map_gets_no_reply(asked):
    stranger = dataclasses.replace(asked[1], map_name="kitchen")
    assert stranger.ask(keys.STATUS, codec.encode(StatusRequest())) is None


def test_what_is_far_is_empty_and_so_is_a_new_map(client):
    for bounds in (None, ((6.4e6, -6.4e6, 0), (6.5e6, -6.3e6, 9))):
        assert len(client.mesh(bounds).faces) == 0
    result = client.query_sdf([[0, 0, 0], [1e9, 0, 0], [-1e9, 1e9, 1e9]], gradient=True)
    assert (result.status == triquad_client.Status.UNKNOWN).all()
    assert np.isnan(result.sdf).all()
    assert np.isnan(result.gradient).all()


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    st.sampled_from(OPERATIONS),
    st.one_of(
        st.binary(max_size=100),
        st.dictionaries(
            st.sampled_from(["triquad", "kind", "points", "origin", "epoch", "x", "timeout_s"]),
            st.one_of(st.none(), st.integers(-5, 5), st.text(max_size=5), st.booleans()),
        ).map(msgpack.packb),
    ),
)
def test_random_requests_are_always_refused(asked, operation, payload):
    assert asked[1].refusal(operation, payload) in ("bad_request", "bad_version")
