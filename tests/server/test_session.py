"""What a server says where its session cannot be opened."""

import json
import socket
from pathlib import Path
from typing import Any

import pytest
from support import servers
from support.attackers.role_files import free_tls_endpoint
from triquad_server.errors import ListenError
from triquad_server.network import NetworkOptions, configuration, open_session
from triquad_server.settings import Settings
from triquad_tools.credentials.key_folder import KeyFolder


def failure(**options: Any) -> str:
    with pytest.raises(ListenError) as caught:
        open_session(configuration(NetworkOptions(**options), "lab", Settings()))
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
