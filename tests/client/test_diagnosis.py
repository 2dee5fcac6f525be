"""What a client says where no link comes about: the cause, and what to do."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import triquad_client
from support import servers
from support.attackers.role_files import free_tls_endpoint, opened
from triquad_client.errors import ConnectError
from triquad_tools.credentials.key_folder import KeyFolder
from triquad_tools.credentials.roles import SERVER, VIEWER, Holder

DAYS = 1.0


def folder_with_viewer(path: Path, days: float = DAYS) -> KeyFolder:
    folder = KeyFolder.create(path, [], DAYS)
    folder.add(Holder("viewer", VIEWER), days)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> KeyFolder:
    return folder_with_viewer(tmp_path_factory.mktemp("keys") / "keys")


@pytest.fixture(scope="module")
def secured(folder: KeyFolder) -> Iterator[str]:
    """Host and port of a router that wants certificates of the folder."""
    endpoint = free_tls_endpoint()
    with opened(folder.path / f"{SERVER}.json5", None, listen__endpoints=[endpoint]):
        yield endpoint.removeprefix("tls/")


def reason(endpoint: str | None, config: Path | None = None) -> str:
    with pytest.raises(ConnectError) as caught:
        triquad_client.connect(endpoint, timeout_s=2.0, config=config)
    return str(caught.value)


@pytest.mark.parametrize(
    ("endpoint", "why"),
    [
        ("nonsense.invalid", "no address is known of the host 'nonsense.invalid'"),
        (servers.free_endpoint(), "nothing listens at 127.0.0.1"),
        ("http://127.0.0.1:7447", "'http:' is no protocol of Zenoh: use tcp/HOST:PORT"),
        ("tcp://127.0.0.1:7447", "'tcp:' is no protocol of Zenoh: use tcp/HOST:PORT"),
    ],
    ids=["host", "port", "protocol", "url"],
)
def test_why_there_is_no_link_is_told(endpoint: str, why: str) -> None:
    assert why in reason(endpoint)


def test_certificates_that_are_not_there_are_named(tmp_path: Path) -> None:
    missing = tmp_path / "viewer.pem"
    file = tmp_path / "own.json5"
    tls = {"connect_certificate": str(missing)}
    file.write_text(json.dumps({"transport": {"link": {"protocols": ["tls"], "tls": tls}}}))
    why = reason(servers.free_endpoint().removeprefix("tcp/"), file)
    assert f"names {missing} as its connect_certificate: No such file" in why


def test_without_a_certificate_the_file_of_a_role_is_asked_for(secured: str) -> None:
    assert "an encrypted link and a certificate: connect with the file of a role" in reason(secured)


def test_an_expired_certificate_is_told_as_one_that_is_not_taken(
    secured: str, folder: KeyFolder
) -> None:
    expired = folder.add(Holder("expired", VIEWER), -0.01)
    assert "does not take the certificate of this configuration" in reason(secured, expired)


def test_the_file_of_another_authority_is_told(secured: str, tmp_path: Path) -> None:
    other = folder_with_viewer(tmp_path / "other")
    why = reason(secured, other.path / "viewer.json5")
    assert "not of the authority that the configuration trusts" in why


def test_a_host_that_the_certificate_does_not_name_is_told(folder: KeyFolder) -> None:
    endpoint = free_tls_endpoint().replace("127.0.0.1", "127.0.0.2")
    with opened(folder.path / f"{SERVER}.json5", None, listen__endpoints=[endpoint]):
        why = reason(endpoint, folder.path / "viewer.json5")
    assert "not valid for '127.0.0.2' (connect by a host that was given to" in why


def test_a_server_without_encryption_is_told_to_a_client_with_a_role(folder: KeyFolder) -> None:
    endpoint = servers.free_endpoint()
    with servers.raw_session("router", listen=endpoint):
        why = reason(endpoint.replace("tcp/", "tls/"), folder.path / "viewer.json5")
    assert "did not answer by TLS" in why
