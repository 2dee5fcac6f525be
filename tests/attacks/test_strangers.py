"""What comes from beyond the machine of a server that listens on all addresses, and no more."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest
import triquad_client
import zenoh
from support.attackers.beyond import from_beyond
from support.operations import OPERATIONS
from support.servers import (
    MAP,
    SMALL_FILE,
    WAIT_S,
    ServerProcess,
    free_endpoint,
    learn,
    learn_all,
    raw_session,
    server_process,
    sphere,
)
from triquad_client import Client
from triquad_format.wire import codec, keys
from triquad_format.wire.map_messages import CreateMapRequest, DropMapRequest
from triquad_format.wire.messages import CheckpointRequest, ResetRequest

EVERYWHERE = ResetRequest(np.full(3, -np.inf), np.full(3, np.inf))
WILD = ["triquad/**", "**", "triquad/*/admin/**"]
WILD += [f"triquad/{MAP}/admin/*", f"triquad/{MAP}/*/reset"]
MB = 1 << 20
TOKENS = 4000


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """A server on all addresses of this machine, that has mapped a sphere and stored it."""
    folder = tmp_path_factory.mktemp("strangers")
    endpoint = free_endpoint().replace("127.0.0.1", "0.0.0.0")
    arguments = ["--settings", SMALL_FILE, "--store", folder / "store"]
    with server_process(arguments, endpoint) as running:
        with connected(running) as client:
            learn_all(client)  # later epochs have another cause than strangers
            client.checkpoint()
        yield running


@pytest.fixture(scope="module")
def stranger(server: ServerProcess) -> Iterator[zenoh.Session]:
    with raw_session(connect=from_beyond(server.endpoint)) as session:
        yield session


def here(server: ServerProcess) -> str:
    return server.endpoint.replace("0.0.0.0", "127.0.0.1")


def connected(server: ServerProcess, timeout_s: float = 20.0) -> Client:
    return triquad_client.connect(here(server), timeout_s=timeout_s)


def ask(session: zenoh.Session, selector: str, payload: bytes) -> list[zenoh.Reply]:
    """The replies of all who answer."""
    every, apart = zenoh.QueryTarget.ALL, zenoh.ConsolidationMode.NONE
    return list(session.get(selector, payload=payload, target=every, consolidation=apart))


def settle(session: zenoh.Session) -> None:
    """Return once the server has dealt with what was declared before."""
    assert list(session.liveliness().get(keys.alive_key(MAP, "*")))


def test_the_log_says_what_listening_beyond_allows(server):
    (line,) = [line for line in server.lines if "access: " in line]
    assert "from beyond this machine may question and follow the map and publish scans" in line


def test_twenty_requests_of_an_admin_change_nothing(server, stranger):
    with connected(server) as client:
        before = client.status()
        requests = {
            keys.RESET: EVERYWHERE,
            keys.CHECKPOINT: CheckpointRequest(),
            keys.CREATE_MAP: CreateMapRequest("another"),
            keys.DROP_MAP: DropMapRequest("another"),
        }
        for _ in range(20):
            for operation, request in requests.items():
                key = keys.operation_key(MAP, operation)
                assert ask(stranger, key, codec.encode(request)) == []
        after = client.status()
        assert after.last_checkpoint == before.last_checkpoint
        assert after.epoch == before.epoch
        assert client.maps() == [MAP]
        assert client.query_sdf(sphere(20)).status.all()


def test_no_operation_answers_a_wildcard_wherever_it_comes_from(server, stranger):
    with connected(server) as client, raw_session(connect=here(server)) as program:
        before = client.status().epoch
        for selector in WILD:
            assert ask(stranger, selector, codec.encode(EVERYWHERE)) == []
            assert ask(program, selector, codec.encode(EVERYWHERE)) == []
        assert client.status().epoch == before


def test_a_stranger_asks_follows_and_publishes(server):
    with triquad_client.connect(from_beyond(server.endpoint)) as client:
        assert client.publish_scan(sphere(), np.eye(4), source="guest") is None
        assert client.flush(WAIT_S).taken == 1
        assert client.query_sdf(sphere(20)).status.all()
        with pytest.raises(triquad_client.NoReplyError, match="programs of the server's machine"):
            client.reset()


def test_a_stranger_with_the_same_keys_neither_sees_questions_nor_answers(server, stranger):
    seen: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            seen.append(str(query.key_expr))
            query.reply(query.key_expr, b"forged")

    handler = zenoh.handlers.Callback(answer, indirect=False)
    declared = [
        stranger.declare_queryable(keys.operation_key(MAP, operation), handler, complete=True)
        for operation in OPERATIONS
    ]
    settle(stranger)
    with connected(server) as client:
        for _ in range(30):
            assert client.query_sdf(sphere(20)).status.all()
    for queryable in declared:
        queryable.undeclare()
    assert seen == []


def test_a_stranger_does_not_read_scans_which_would_tell_their_session(server, stranger):
    with stranger.declare_subscriber(f"triquad/{MAP}/scan/*") as received:
        settle(stranger)
        with connected(server) as client:
            learn(client, 1)
        settle(stranger)
        assert received.try_recv() is None


def test_messages_that_no_operation_takes_leave_no_memory_behind(server, stranger):
    before = server.resident_bytes
    huge = bytes(200 * MB)
    for key in ("triquad/unknown", f"triquad/{MAP}/scan/huge", f"triquad/{MAP}/query/sdf"):
        stranger.put(key, huge, congestion_control=zenoh.CongestionControl.BLOCK)
    with connected(server) as client:
        assert client.query_sdf(sphere(20)).status.all()
    assert server.resident_bytes - before < 60 * MB


def test_an_honest_client_gets_in_beside_half_open_links(server):
    host, _, port = here(server).removeprefix("tcp/").rpartition(":")
    with ExitStack() as links:
        for _ in range(900):  # which never say a word
            link = links.enter_context(socket.socket())
            link.setblocking(False)
            link.connect_ex((host, int(port)))
        with connected(server) as client:
            assert client.query_sdf(sphere(20)).status.all()


@pytest.mark.parametrize("beyond", [True, False])
def test_an_honest_client_finds_its_map_among_thousands_of_tokens(server, beyond):
    endpoint = from_beyond(server.endpoint) if beyond else here(server)
    with raw_session(connect=endpoint) as hostile:
        declare = hostile.liveliness().declare_token
        tokens = [declare(keys.alive_key(f"m{number}", "x")) for number in range(TOKENS)]
        settle(hostile)
        with connected(server) as client:
            assert client.query_sdf(sphere(20)).status.all()
            if beyond:
                assert client.maps() == [MAP]
        del tokens
