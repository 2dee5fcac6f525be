import msgpack
import pytest
from triquad_format.errors import WireError
from triquad_format.wire import codec
from triquad_format.wire.messages import StatusRequest
from triquad_format.wire.unpacking import unpacked


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
