"""The client where things go wrong."""

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import triquad_client
import zenoh
from support import servers
from triquad_client import (
    ClosedError,
    ConnectError,
    InvalidInputError,
    NoReplyError,
    RefusedError,
    RequestTimeoutError,
    UnknownMapError,
)
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply, FlushReply, SdfReply, SdfRequest

POSE = np.eye(4)
CLOUD = np.ones((10, 3), np.float32)


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with servers.running_service() as endpoint:
        yield endpoint


def test_something_else_that_listens_is_a_connect_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        endpoint = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        with pytest.raises(ConnectError, match="cannot connect"):
            triquad_client.connect(endpoint, timeout_s=0.3)


@pytest.mark.parametrize("endpoint", ["", "7447", "robot:http", "tcp/", "tcp/robot:99999"])
def test_what_cannot_be_an_endpoint_is_refused_with_what_to_write(endpoint: str) -> None:
    with pytest.raises(InvalidInputError, match="use HOST, HOST:PORT or an endpoint of Zenoh"):
        triquad_client.connect(endpoint)


def test_an_unknown_map_lists_the_maps_there_are(endpoint: str) -> None:
    with pytest.raises(UnknownMapError, match="available: default") as caught:
        triquad_client.connect(endpoint, "kitchen")
    assert caught.value.available == ["default"]


def test_a_router_without_maps_is_told_apart() -> None:
    endpoint = servers.free_endpoint()
    with (
        servers.raw_session("router", listen=endpoint),
        pytest.raises(UnknownMapError, match="available: none"),
    ):
        triquad_client.connect(endpoint, timeout_s=0.5)


@pytest.mark.parametrize("name", ["a/b", None])
def test_a_map_name_that_cannot_be_is_refused(endpoint: str, name: Any) -> None:
    with pytest.raises(InvalidInputError, match=f"map name {name!r}"):
        triquad_client.connect(endpoint, name)


@pytest.mark.parametrize("timeout_s", [10**400, -1, 0, 0.0, np.inf, "long"])
def test_a_timeout_that_cannot_be_is_refused(endpoint: str, timeout_s: Any) -> None:
    with pytest.raises(InvalidInputError, match="timeout_s = "):
        triquad_client.connect(endpoint, timeout_s=timeout_s)


def test_two_maps_on_one_network_do_not_disturb_each_other() -> None:
    with (
        servers.running_service(map_name="ground") as ground,
        servers.running_service(map_name="cellar", connect=(ground,)),
        triquad_client.connect(ground, "ground") as upstairs,
    ):
        # Two routers exchange what they know some time after they are up.
        servers.until(lambda: upstairs.maps() == ["cellar", "ground"], upstairs.maps)
        with triquad_client.connect(ground, "cellar") as downstairs:
            downstairs.publish_scan(servers.sphere(), POSE)
            assert downstairs.flush(servers.WAIT_S).taken == 1
            assert downstairs.status().scans_taken == 1
        assert upstairs.status().scans_taken == 0
        assert upstairs.status().regions == 0


def test_a_closed_client_says_so(endpoint: str) -> None:
    client = triquad_client.connect(endpoint)
    client.close()
    client.close()
    for call in (client.status, client.maps, lambda: client.publish_scan(CLOUD, POSE)):
        with pytest.raises(ClosedError):
            call()


def test_silence_though_the_map_is_there_is_told_apart() -> None:
    with (
        servers.answering({}) as endpoint,
        triquad_client.connect(endpoint) as client,
        pytest.raises(NoReplyError, match="access control"),
    ):
        client.status()


def test_a_reply_that_never_comes_is_a_timeout() -> None:
    held = []
    with (
        servers.answering({keys.SDF: lambda query, _: held.append(query)}) as endpoint,
        triquad_client.connect(endpoint, timeout_s=0.2) as client,
    ):
        with pytest.raises(RequestTimeoutError, match=r"query/sdf within 0\.2 s"):
            client.query_sdf(CLOUD)
        held[0].drop()


def test_a_scan_that_stays_out_of_the_map_is_not_waited_for_without_end() -> None:
    def answer(query: zenoh.Query, key: str) -> None:
        with query:
            query.reply(key, codec.encode(FlushReply(False, 7, 2, 1, None)))

    with (
        servers.answering({keys.FLUSH: answer}) as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        client.publish_scan(CLOUD, POSE)
        with pytest.raises(
            RequestTimeoutError,
            match=r"scan 0 .* after 0\.2 s; so far 7 .* taken, 2 refused, 1 lost",
        ):
            client.flush(0.2)
        with pytest.raises(RequestTimeoutError, match=r"still learns after 0\.2 s"):
            client.settle(0.2)
        with pytest.raises(InvalidInputError, match="timeout_s = "):
            client.settle(np.nan)


def test_a_query_whose_epoch_goes_starts_again_and_gives_up_after_three_tries() -> None:
    first_parts = []

    def answer(query: zenoh.Query, key: str) -> None:
        request = codec.decode(SdfRequest, query.payload.to_bytes())
        with query:
            if request.epoch:
                query.reply_err(codec.encode(ErrorReply("epoch_gone", "")))
                return
            first_parts.append(request)
            count = len(request.points)
            reply = SdfReply(3, np.zeros(count, np.float32), np.zeros(count, np.uint8), None)
            query.reply(key, codec.encode(reply))

    with (
        servers.answering({keys.SDF: answer}) as endpoint,
        triquad_client.connect(endpoint) as client,
        pytest.raises(RefusedError, match="epoch_gone"),
    ):
        client.query_sdf(np.zeros((150_000, 3)))
    assert len(first_parts) == 3


def test_a_zenoh_configuration_file_is_used(endpoint: str, tmp_path: Path) -> None:
    file = tmp_path / "client.json5"
    file.write_text('{ mode: "client", scouting: { multicast: { enabled: false } } }')
    with triquad_client.connect(endpoint, config=file) as client:
        assert client.status().map_name == servers.MAP
    file.write_text("{ mode: 'submarine' }")
    with pytest.raises(ConnectError, match="client.json5: "):
        triquad_client.connect(endpoint, config=file)
    with pytest.raises(ConnectError, match="missing.json5: No such file"):
        triquad_client.connect(endpoint, config=tmp_path / "missing.json5")
