import msgpack
import pytest
from triquad_format.errors import WireError
from triquad_format.wire import codec
from triquad_format.wire.messages import StatusRequest
from triquad_format.wire.structure import check_structure


@pytest.mark.parametrize("innermost", [b"\x01", b"\xc4\x01x", b"\x90", b"\x80"])
def test_what_holds_nothing_is_no_level_of_its_own(innermost):
    check_structure(b"\x91" * 15 + innermost)
    with pytest.raises(WireError, match="deep"):
        check_structure(b"\x91" * 16 + innermost)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (
            b"\x81\xa1a\xdd" + (9).to_bytes(4, "big") + (b"\xdc\xff\xff" + b"\x90" * 65535) * 9,
            "objects",
        ),
        (b"\xdd\xff\xff\xff\xff", "objects"),
        (b"\x91" * 5000 + b"\x01", "deep"),
        (b"\x82\xa7triquad\x01\xa4kind" + b"\x91" * 1000 + b"\x01", "deep"),
        (msgpack.packb({"a": 1}) + b"\x00", "follows"),
        (msgpack.packb({"a": b"123456"})[:-1], "incomplete"),
        (msgpack.packb(msgpack.ExtType(3, b"x")), "type"),
        (b"", "incomplete"),
    ],
)
def test_bombs_are_refused_before_anything_is_built(payload, words):
    with pytest.raises(WireError, match=words):
        codec.decode(StatusRequest, payload)
