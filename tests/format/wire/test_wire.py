import dataclasses

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.server_records import STATUS
from triquad_format.errors import ProtocolVersionError, WireError
from triquad_format.wire import codec
from triquad_format.wire.mesh_messages import TileList, TileListRequest
from triquad_format.wire.messages import (
    FlushReply,
    MapChunk,
    Scan,
    SdfReply,
    SdfRequest,
)
from triquad_format.wire.packing import unpacked
from triquad_format.wire.status_messages import StatusRequest

POSE = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], np.float64)
POINTS = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
SCAN = Scan(POINTS, POSE, 123, "lidar", 2**62, 4)
EXAMPLES = [
    SCAN,
    SdfRequest(np.array([1e6, 2e6, 3.0]), POINTS, True, 0),
    SdfReply(5, np.array([0.5, np.nan], np.float32), np.array([1, 0], np.uint8), None),
    SdfReply(5, np.zeros(0, np.float32), np.zeros(0, np.uint8), np.zeros((0, 3), np.float32)),
    TileList(2, 6.4, np.array([[-1, 0, 1]], np.int32)),
    StatusRequest(),
    STATUS,
    FlushReply(True, 1, 2, 3, None),
    MapChunk(0, b"\x00\xff"),
]


def same(left, right):
    if isinstance(left, np.ndarray):
        return left.dtype == right.dtype and np.array_equal(left, right, equal_nan=True)
    return left == right


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_round_trip(message):
    copy = codec.decode(type(message), codec.encode(message))
    for part in dataclasses.fields(message):
        assert same(getattr(message, part.name), getattr(copy, part.name)), part.name


def test_golden_bytes_of_a_request_without_fields():
    assert codec.encode(StatusRequest()) == b"\x82\xa7triquad\x01\xa4kind\xadStatusRequest"


def test_golden_bytes_of_a_query():
    request = SdfRequest(np.array([1.0, 0.0, -2.0]), np.array([[0.5, 0, 0]], np.float32), False, 0)
    assert codec.encode(request) == (
        b"\x86\xa7triquad\x01\xa4kind\xaaSdfRequest"
        b"\xa6origin\x83\xa5dtype\xa3<f8\xa5shape\x91\x03\xa4data\xc4\x18"
        b"\x00\x00\x00\x00\x00\x00\xf0\x3f" + bytes(8) + b"\x00\x00\x00\x00\x00\x00\x00\xc0"
        b"\xa6points\x83\xa5dtype\xa3<f4\xa5shape\x92\x01\x03\xa4data\xc4\x0c"
        b"\x00\x00\x00\x3f" + bytes(8) + b"\xa8gradient\xc2\xa5epoch\x00"
    )


def test_big_endian_and_strided_arrays_travel_as_little_endian():
    points = np.array([[1, 2, 3], [4, 5, 6]], np.float32)[::-1]
    request = SdfRequest(np.zeros(3), points, False, 0)
    assert np.array_equal(codec.decode(SdfRequest, codec.encode(request)).points, points)


def test_fields_of_a_later_revision_are_ignored():
    body = msgpack.unpackb(codec.encode(StatusRequest()))
    assert codec.decode(StatusRequest, msgpack.packb(body | {"later": 1})) == StatusRequest()


def test_fields_with_a_default_may_be_missing():
    body = msgpack.unpackb(codec.encode(TileListRequest(np.zeros(3), np.ones(3), 4, 1)))
    assert codec.decode(TileListRequest, msgpack.packb(body)).level == 1
    del body["level"]
    without = codec.decode(TileListRequest, msgpack.packb(body))
    assert (without.level, without.epoch, without.fill_m) == (0, 4, 0.0)
    np.testing.assert_array_equal(without.maximum, np.ones(3))
    del body["epoch"]
    with pytest.raises(WireError, match="TileListRequest.epoch: missing"):
        codec.decode(TileListRequest, msgpack.packb(body))


def changed(message, **changes):
    return msgpack.packb(msgpack.unpackb(codec.encode(message)) | changes)


def array(dtype="<f4", shape=(2, 3), data=bytes(24)):
    return {"dtype": dtype, "shape": list(shape) if isinstance(shape, tuple) else shape} | {
        "data": data
    }


@pytest.mark.parametrize(
    "points",
    [
        array("<f8", (2, 3), bytes(48)),
        array("|O", (2, 3)),
        array([], (2, 3)),
        array("<f4", (3, 2)),
        array("<f4", (6,)),
        array("<f4", (2, 3), bytes(23)),
        array("<f4", (2, 3), "text"),
        array("<f4", (2**39, 3), b""),
        array("<f4", (2**63, 3), b""),
        array("<f4", (-1, 3), b""),
        array("<f4", (True, 3), bytes(12)),
        array("<f4", (2.0, 3)),
        array("<f4", None),
        array("<f4", (1,) * 9, bytes(4)),
        {"dtype": "<f4"},
        [1, 2, 3],
        None,
    ],
)
def test_arrays_that_lie_are_refused(points):
    with pytest.raises(WireError, match=r"Scan\.points"):
        codec.decode(Scan, changed(SCAN, points=points))


@pytest.mark.parametrize(
    ("name", "value"),
    [("stamp_ns", 1.5), ("stamp_ns", True), ("source", 1), ("session", 2**64 - 1), ("source", b"")],
)
def test_fields_of_another_type_are_refused_by_name(name, value):
    with pytest.raises(WireError, match=f"Scan.{name}"):
        codec.decode(Scan, changed(SCAN, **{name: value}))


def test_another_version_is_told_apart():
    with pytest.raises(ProtocolVersionError, match="version 2"):
        codec.decode(Scan, changed(SCAN, triquad=2))


def test_another_kind_is_refused():
    with pytest.raises(WireError, match="expected a Scan, got 'StatusRequest'"):
        codec.decode(Scan, codec.encode(StatusRequest()))


@given(st.binary(max_size=200))
def test_random_bytes_never_do_more_than_refuse(payload):
    with pytest.raises(WireError):
        codec.decode(Scan, payload)


@given(st.sampled_from(EXAMPLES), st.data())
def test_cut_messages_are_refused(message, data):
    payload = codec.encode(message)
    length = data.draw(st.integers(0, len(payload) - 1))
    with pytest.raises(WireError):
        codec.decode(type(message), payload[:length])


@given(st.sampled_from(EXAMPLES), st.data())
def test_messages_with_a_changed_byte_are_read_or_refused(message, data):
    payload = bytearray(codec.encode(message))
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    try:
        read = codec.decode(type(message), bytes(payload))
    except WireError:
        return
    assert type(read) is type(message)


@pytest.mark.parametrize(
    "message",
    [
        dataclasses.replace(SCAN, points=POINTS.astype(np.float64)),
        dataclasses.replace(SCAN, points=POINTS.T),
        dataclasses.replace(SCAN, source=3),
        dataclasses.replace(SCAN, session=2**63),
        dataclasses.replace(STATUS, scans_dropped={"a": "b"}),
    ],
)
def test_values_that_do_not_fit_are_not_encoded(message):
    with pytest.raises(WireError):
        codec.encode(message)


@pytest.mark.parametrize("innermost", [b"\x01", b"\xc4\x01x"])
def test_what_holds_nothing_is_no_level_of_its_own(innermost):
    unpacked(b"\x91" * 16 + innermost)
    with pytest.raises(WireError, match="deep"):
        unpacked(b"\x91" * 17 + innermost)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (msgpack.packb([[[1] * 60] * 60] * 60), "objects"),
        (msgpack.packb([{f"{number}": 0 for number in range(4096)}] * 6), "objects"),
        (b"\xdd\xff\xff\xff\xff", "max_array_len"),
        (b"\xdf\xff\xff\xff\xff", "max_map_len"),
        (b"\x91" * 5000 + b"\x01", "not msgpack"),
        (b"\x82\xa7triquad\x01\xa4kind" + b"\x91" * 1000 + b"\x01", "deep"),
        (msgpack.packb({"a": 1}) + b"\x00", "extra data"),
        (msgpack.packb({"a": b"123456"})[:-1], "incomplete"),
        (msgpack.packb(msgpack.ExtType(3, b"x")), "max_ext_len"),
        (b"", "incomplete"),
    ],
)
def test_bombs_are_refused(payload, words):
    with pytest.raises(WireError, match=words):
        codec.decode(StatusRequest, payload)
