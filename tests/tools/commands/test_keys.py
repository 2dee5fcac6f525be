import json
from pathlib import Path

import pytest
import zenoh
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from triquad_tools.commands import keys
from triquad_tools.console.command import BAD_INPUT, OK
from triquad_tools.credentials.key_folder import KeyFolder
from triquad_tools.credentials.roles import ROBOT, Holder

WORLD = 0o077


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "keys"
    hosts = ("--host", "robot.local", "--host", "10.0.0.7", "--host", "fe80::1")
    assert keys.main(["init", str(path), *hosts]) == OK
    return path


def config(file: Path) -> zenoh.Config:
    return zenoh.Config.from_file(str(file))


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert keys.main([*map(str, arguments)]) == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_nobody_else_can_read_what_is_written(path: Path) -> None:
    assert keys.main(["robot", str(path), "front", "--source", "roof"]) == OK
    written = [path, *path.rglob("*")]
    assert {"server.json5", "router.json5", "front.json5", "authority.json"} <= {
        file.name for file in written
    }
    assert [file for file in written if file.stat().st_mode & WORLD] == []


def test_a_folder_that_is_there_is_left_alone(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {file: file.read_bytes() for file in path.rglob("*.*")}
    assert "is there already" in refused(capsys, "init", path)
    assert {file: file.read_bytes() for file in path.rglob("*.*")} == before


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("viewer", "viewer"), "'viewer' is there already, with the role viewer"),
        (("viewer", "server"), "'server' is there already, with the role server"),
        (("viewer", "a/b"), "role name 'a/b' is not allowed"),
        (("viewer", "x" * 49), "more than 48 characters"),
        (("robot", "front", "--source", "default"), "source 'default' is that of 'robot'"),
        (("robot", "front", "--source", "*"), "source name '*' is not allowed"),
        (("renew", "nobody"), "nobody is called 'nobody'; there are: server, router, viewer"),
        (("remove", "server"), "'server' is no client"),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(
    path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], reason: str
) -> None:
    before = {file: file.read_bytes() for file in path.rglob("*.*")}
    command, *others = arguments
    assert reason in refused(capsys, command, path, *others)
    assert {file: file.read_bytes() for file in path.rglob("*.*")} == before


@pytest.mark.parametrize("host", ["robot:7447", "tcp/robot", "10", ""])
def test_a_host_that_is_none_is_refused_before_anything_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], host: str
) -> None:
    assert f"host {host!r}" in refused(capsys, "init", tmp_path / "keys", f"--host={host}")
    assert list(tmp_path.iterdir()) == []


def test_no_other_folder_is_taken_for_one_of_keys(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"triquad-keys init {tmp_path}" in refused(capsys, "list", tmp_path)
    for damaged in ("[]", "{", '{"hosts": [], "roles": [{"name": "viewer"}]}'):
        (path / "authority.json").write_text(damaged)
        assert "authority.json is damaged" in refused(capsys, "list", path)


def test_certificates_are_for_one_purpose(path: Path) -> None:
    folder = KeyFolder.open(path)
    server = folder.certificates["server"].parsed
    names = server.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {"localhost", "robot.local"} <= set(names.get_values_for_type(x509.DNSName))
    addresses = {str(found) for found in names.get_values_for_type(x509.IPAddress)}
    assert {"127.0.0.1", "::1", "10.0.0.7", "fe80::1"} <= addresses
    client = folder.authority.issue("viewer:x", 1.0).parsed
    usage = client.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    for certificate in (server, client):
        certificate.verify_directly_issued_by(folder.authority.parsed)
        basic = certificate.extensions.get_extension_for_class(x509.BasicConstraints)
        assert (basic.critical, basic.value.ca) == (True, False)


def test_every_file_is_one_of_zenoh_that_denies_by_default(path: Path) -> None:
    for file in path.glob("*.json5"):
        read = config(file)
        access = json.loads(read.get_json("access_control"))
        assert (access["enabled"], access["default_permission"]) == (True, "deny")
        assert read.get_json("scouting/multicast/enabled") == "false"
        assert json.loads(read.get_json("transport/link/protocols")) == ["tls"]
        assert read.get_json("transport/link/tls/enable_mtls") == "true"
    hosts = json.loads(config(path / "viewer.json5").get_json("connect/endpoints"))
    assert hosts == ["tls/robot.local:7447", "tls/10.0.0.7:7447", "tls/[fe80::1]:7447"]


def subjects(path: Path) -> set[str]:
    listed = json.loads(config(path / "server.json5").get_json("access_control/subjects"))
    return {name.rpartition(":")[0] for entry in listed for name in entry["cert_common_names"]}


def test_who_was_removed_stays_so_when_the_name_is_given_again(path: Path) -> None:
    folder = KeyFolder.open(path)
    first = folder.holder("viewer").common_name
    assert "viewer:viewer" in subjects(path)
    assert keys.main(["remove", str(path), "viewer"]) == OK
    assert "viewer:viewer" not in subjects(path)
    assert not (path / "viewer.json5").exists()
    assert keys.main(["viewer", str(path), "viewer"]) == OK
    assert KeyFolder.open(path).holder("viewer").common_name != first


def test_renewing_changes_the_certificate_and_not_the_role(path: Path) -> None:
    folder = KeyFolder.open(path)
    role, before = folder.holder("robot"), (path / "robot.json5").read_bytes()
    server = folder.certificates["server"]
    assert keys.main(["renew", str(path), "robot", "server", "--days", "2"]) == OK
    renewed = KeyFolder.open(path)
    assert renewed.holder("robot") == role
    assert (path / "robot.json5").read_bytes() != before
    assert renewed.certificates["server"].pem != server.pem
    until = renewed.certificates["server"].parsed.not_valid_after_utc
    assert until < server.parsed.not_valid_after_utc


def test_the_list_tells_roles_sources_and_what_has_expired(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    KeyFolder.open(path).add(Holder("old", ROBOT, ("roof", "bumper"), 7), days=-1e-3)
    capsys.readouterr()
    assert keys.main(["list", str(path)]) == OK
    lines = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    assert lines["server"][:4] == ["server", "server", "robot.local,", "10.0.0.7,"]
    assert lines["old"][:5] == ["old", "robot", "roof,", "bumper", "7"]
    assert lines["old"][-1] == "EXPIRED"
    assert lines["admin"][-1] != "EXPIRED"
