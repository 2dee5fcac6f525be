"""What of a Zenoh configuration a server sets, and what it leaves as a file has it."""

import json
import socket
from pathlib import Path
from typing import Any

import pytest
import triquad_server.network as network
from support import servers
from support.attackers.role_files import free_tls_endpoint
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT
from triquad_server.errors import ListenError, ServerError
from triquad_server.network import Configuration, NetworkOptions, configuration, open_session
from triquad_server.settings import Settings
from triquad_tools.credentials.key_folder import KeyFolder

SAFE = {
    "mode": "router",
    "listen/endpoints": [DEFAULT_ENDPOINT],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/unicast/max_sessions": 500,
    "transport/unicast/accept_pending": 1000,
    "transport/unicast/accept_timeout": 5000,
    "transport/link/rx/max_message_size": 32_004_096,  # 64 bytes for each point of a scan
    "access_control/enabled": True,
    "access_control/default_permission": "deny",
}


def of_file(folder: Path, text: str, **options: Any) -> Configuration:
    file = folder / "zenoh.json5"
    file.write_text(text)
    return network.configuration(NetworkOptions(config_file=file, **options), Settings())


def values(config: Configuration) -> dict[str, Any]:
    return {path: json.loads(config.zenoh.get_json(path)) for path in SAFE}


def test_what_is_not_set_is_safe(tmp_path):
    plain = network.configuration(NetworkOptions(), Settings())
    assert values(plain) == SAFE
    assert not plain.listens_beyond
    assert values(of_file(tmp_path, "{ timestamping: { enabled: true } }")) == SAFE


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ('{ mode: "peer" }', "mode", "peer"),
        (
            '{ listen: { endpoints: ["tcp/[::]:7448"] } }',
            "listen/endpoints",
            ["tcp/[::]:7448"],
        ),
        (
            "{ scouting: { multicast: { enabled: true } } }",
            "scouting/multicast/enabled",
            True,
        ),
        (
            '{ transport: { shared_memory: { enabled: true, mode: "init" } } }',
            "transport/shared_memory/enabled",
            True,
        ),
        (
            "{ transport: { unicast: { max_sessions: 7 } } }",
            "transport/unicast/max_sessions",
            7,
        ),
    ],
)
def test_a_file_has_the_say_in_what_it_sets_and_in_nothing_else(tmp_path, text, path, value):
    assert values(of_file(tmp_path, text)) == {**SAFE, path: value}


def test_options_go_before_the_file(tmp_path):
    text = '{ mode: "peer", listen: { endpoints: ["tcp/[::]:1"] } }'
    config = of_file(tmp_path, text, mode="router", listen=("tcp/0.0.0.0:2",))
    assert (config.mode, config.listen) == ("router", ("tcp/0.0.0.0:2",))
    assert config.listens_beyond


def test_access_control_of_a_file_is_taken_as_it_is(tmp_path):
    config = of_file(tmp_path, '{ access_control: { enabled: true, default_permission: "allow" } }')
    assert not config.own_access_control
    assert json.loads(config.zenoh.get_json("access_control/default_permission")) == "allow"


def test_a_client_listens_nowhere(tmp_path):
    config = of_file(tmp_path, "{}", mode="client", connect=("tcp/router:7447",))
    assert (config.listen, config.connect) == ((), ("tcp/router:7447",))


def test_a_file_that_is_none_is_an_error(tmp_path):
    with pytest.raises(ServerError, match=rf"Zenoh configuration {tmp_path}\S+: JSON error"):
        of_file(tmp_path, "{ mode: 3 }")


def failure(**options: Any) -> str:
    with pytest.raises(ListenError) as caught:
        open_session(configuration(NetworkOptions(**options), Settings()))
    return str(caught.value)


def test_credentials_that_cannot_be_read_are_not_taken_for_another_server(tmp_path: Path) -> None:
    file = tmp_path / "own.json5"
    tls = {"listen_certificate": str(tmp_path / "no.pem"), "listen_private_key": "no-key.pem"}
    file.write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    why = failure(config_file=file, listen=(free_tls_endpoint(),))
    assert "check the credentials" in why
    assert "another server" not in why


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_a_port_in_use_is_told_as_such(protocol: str, tmp_path: Path) -> None:
    file = KeyFolder.create(tmp_path / "keys", [], 1.0).path / "server.json5"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"{protocol}/127.0.0.1:{taken.getsockname()[1]}"
        why = failure(config_file=file if protocol == "tls" else None, listen=(endpoint,))
    assert "is another server running there" in why


def test_a_host_that_nobody_knows_is_not_taken_for_another_server() -> None:
    why = failure(listen=("tcp/no-such-host.invalid:7447",))
    assert "give --listen an address of this machine" in why
    assert "another server" not in why


def test_a_protocol_that_is_none_is_told_with_what_to_write() -> None:
    endpoint = servers.free_endpoint().replace("tcp/", "http://")
    assert "(write --listen tcp/HOST:PORT)" in failure(listen=(endpoint,))
