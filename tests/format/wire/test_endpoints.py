"""Endpoints, as people write them."""

import pytest
from triquad_format.errors import FormatError
from triquad_format.wire.endpoints import full_endpoint


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("robot", "tcp/robot:7447"),
        ("robot:7448", "tcp/robot:7448"),
        ("robot.local:65535", "tcp/robot.local:65535"),
        ("192.168.0.7", "tcp/192.168.0.7:7447"),
        ("0.0.0.0:7447", "tcp/0.0.0.0:7447"),
        ("::1", "tcp/[::1]:7447"),
        ("[::1]", "tcp/[::1]:7447"),
        ("[fe80::2]:7448", "tcp/[fe80::2]:7448"),
        ("tcp/robot:7447", "tcp/robot:7447"),
        ("tls/robot:7447#root_ca=ca.pem", "tls/robot:7447#root_ca=ca.pem"),
        ("tcp/[::1]:0?rel=0", "tcp/[::1]:0?rel=0"),
        ("unixsock-stream//run/triquad.sock", "unixsock-stream//run/triquad.sock"),
    ],
)
def test_a_host_stands_for_an_endpoint(text: str, endpoint: str) -> None:
    assert full_endpoint(text) == endpoint


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "endpoint ''"),
        (" robot", "endpoint ' robot'"),
        ("7447", "'7447' is not a host"),
        (":7447", "'' is not a host"),
        ("my robot", "'my robot' is not a host"),
        ("robot:", "'' is not a port"),
        ("robot:http", "'http' is not a port from 1 to 65535"),
        ("robot:0", "'0' is not a port"),
        ("robot:65536", "'65536' is not a port"),
        ("robot:-1", "'-1' is not a port"),
        ("[::1]7447x", "'7447x' is not a port"),
        (None, "endpoint None"),
    ],
)
def test_what_is_neither_is_refused_with_what_to_write(text: str, words: str) -> None:
    with pytest.raises(FormatError) as raised:
        full_endpoint(text)
    assert words in str(raised.value)
    assert "use HOST, HOST:PORT or an endpoint of Zenoh such as tcp/robot:7447" in str(raised.value)


@pytest.mark.parametrize(
    ("text", "port"),
    [
        ("tcp/robot:99999", "99999"),
        ("tls/robot:http#root_ca=ca.pem", "http"),
        ("udp/[::1]", "1]"),
        ("tcp/robot", "robot"),
    ],
)
def test_an_endpoint_of_zenoh_without_a_port_is_refused(text: str, port: str) -> None:
    with pytest.raises(FormatError) as raised:
        full_endpoint(text)
    assert f"{port!r} is not a port up to 65535; use HOST, HOST:PORT or" in str(raised.value)


def test_a_host_is_reached_by_the_protocol_that_is_asked_for() -> None:
    assert full_endpoint("robot", "tls") == "tls/robot:7447"
    assert full_endpoint("tcp/robot:1", "tls") == "tcp/robot:1"
