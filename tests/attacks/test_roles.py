"""Every role tries every operation, over real mTLS: at the server itself, and through a router."""

import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import triquad_client
import zenoh
from support.attackers.role_files import free_tls_endpoint, opened, showing
from support.attackers.role_matrix import OTHERS, OWN, achieved, expected
from support.poses import shifted
from support.ros.ros_bridge import MAST, bridging, stand
from support.ros.ros_robot import RmwZenoh, Robot
from support.ros_messages import RosMessages
from support.servers import SMALL_FILE, WAIT_S, server_process, sphere
from triquad_client.errors import ConnectError, NoReplyError, UnknownMapError
from triquad_client.net.shared_connection import SharedConnection
from triquad_format.records.status import Status
from triquad_format.wire import keys
from triquad_format.wire.shares import lease_key
from triquad_tools.commands import inspect, top
from triquad_tools.console.command import FAILED, OK
from triquad_tools.credentials.certificates import new_authority
from triquad_tools.credentials.key_folder import KeyFolder
from triquad_tools.credentials.roles import ROBOT, ROLES, ROUTER, SERVER, Holder

DAYS = 1.0
PATHS = ("server", "router")
MEMBERS = {"viewer": (), "robot": (OWN,), "admin": (), "removed": (OTHERS,)}  # and their sources
STRANGERS = ("forged authority", "no certificate", "expired")
EVERYBODY = (*MEMBERS, *STRANGERS)

Results = dict[str, set[str]]  # of each, what he achieved


@dataclass(frozen=True)
class Network:
    """A server, and a router that leads to it, which go by the files in a folder."""

    folder: KeyFolder
    endpoints: dict[str, str]  # by path

    def file(self, name: str) -> Path:
        return self.folder.path / f"{name}.json5"

    @contextmanager
    def session(self, who: str, path: str) -> Iterator[zenoh.Session]:
        """Of a member; a stranger comes with the file of the robot, and his own certificate."""
        name = self.folder.holder("robot").common_name
        changes = {
            "forged authority": showing(new_authority("forged").issue(name, DAYS)),
            "no certificate": {"transport__link__tls__enable_mtls": False},
            "expired": showing(self.folder.authority.issue(name, -0.01)),
        }
        file = self.file(who if who in MEMBERS else "robot")
        with opened(file, self.endpoints[path], **changes.get(who, {})) as session:
            yield session

    @contextmanager
    def observer(self, path: str) -> Iterator[zenoh.Session]:
        """A session that sees all that passes; routers may."""
        as_client = {"mode": "client", "listen__endpoints": []}
        with opened(self.file(ROUTER), self.endpoints[path], **as_client) as session:
            yield session


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> KeyFolder:
    folder = KeyFolder.create(tmp_path_factory.mktemp("roles") / "keys", [], DAYS)
    for role in ROLES:
        folder.add(Holder(role, role, MEMBERS[role]), DAYS)
    folder.add(Holder("nodes", ROBOT, ros2_domain=0), DAYS)
    folder.add(Holder("bridge", ROBOT, PATHS, ros2_domain=0), DAYS)
    file = folder.add(Holder("removed", ROBOT, MEMBERS["removed"]), DAYS)
    copied = file.read_bytes()
    folder.remove("removed")
    file.write_bytes(copied)
    return folder


@pytest.fixture(scope="module")
def network(folder: KeyFolder) -> Iterator[Network]:
    server = folder.path / "server.json5"
    endpoints = {path: free_tls_endpoint() for path in PATHS}
    router = zenoh.Config.from_file(str(server))
    router.insert_json5("listen/endpoints", json.dumps([endpoints["router"]]))
    own = showing(folder.certificates[ROUTER], "connect", "listen")
    for name, value in own.items():
        router.insert_json5(name.replace("__", "/"), json.dumps(value))
    arguments = ["--config", server, "--settings", SMALL_FILE, "--connect", endpoints["router"]]
    with (
        zenoh.open(router),
        server_process(arguments, endpoints["server"]),
    ):
        yield Network(folder, endpoints)


def results(network: Network, path: str) -> Results:
    """What everybody achieves, all at the same time."""

    def attempt(who: str) -> set[str]:
        try:
            with network.session(who, path) as session:
                return achieved(who, session, observer)
        except zenoh.ZError:  # not let in
            return set()

    with network.observer(path) as observer, ThreadPoolExecutor(len(EVERYBODY)) as threads:
        return dict(zip(EVERYBODY, threads.map(attempt, EVERYBODY), strict=True))


@pytest.mark.parametrize("path", PATHS)
def test_each_may_do_what_the_role_says_and_nothing_else(network: Network, path: str) -> None:
    assert results(network, path) == {who: expected(who, MEMBERS.get(who, ())) for who in EVERYBODY}


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_nothing_is_gained_by_another_mode(network: Network, mode: str) -> None:
    as_member = {"mode": mode, "listen__endpoints": []}
    with (
        network.observer("server") as observer,
        opened(network.file("robot"), network.endpoints["server"], **as_member) as session,
    ):
        assert achieved(mode, session, observer) <= expected("robot", MEMBERS["robot"])


def test_roles_work_together(network: Network) -> None:
    with ExitStack() as clients:
        robot, viewer, admin = (
            clients.enter_context(connected(network, "server", who))
            for who in ("robot", "viewer", "admin")
        )
        for _ in range(2):
            robot.publish_scan(sphere(), np.eye(4), source=OWN)
        assert robot.flush(WAIT_S).taken == 2
        assert viewer.query_distance([[3.0, 0.0, 0.0]]).epoch > 0
        for outsider in (viewer, robot):
            with pytest.raises(NoReplyError, match="access control"):
                outsider.reset()
        assert admin.reset().epoch > 0


def connected(network: Network, path: str, who: str) -> triquad_client.Client:
    return triquad_client.connect(network.endpoints[path], config=network.file(who))


IMPOSTORS = {
    "with the certificate of a robot": lambda own: own.issue("robot:x", DAYS),
    "of a forged authority": lambda _: new_authority("forged").issue(SERVER, DAYS, []),
    "that is let in, but is no server": lambda own: own.issue("viewer:x", DAYS, []),
}


@pytest.mark.parametrize("kind", IMPOSTORS)
def test_clients_believe_no_server_but_those_they_know(folder: KeyFolder, kind: str) -> None:
    endpoint = free_tls_endpoint()
    certificate = IMPOSTORS[kind](folder.authority)
    listens = {"mode": "router", "listen__endpoints": [endpoint]}
    with (
        impostor(folder, endpoint, {**listens, **showing(certificate, "listen")}),
        pytest.raises((ConnectError, UnknownMapError)),
    ):
        triquad_client.connect(endpoint, timeout_s=2.0, config=folder.path / "viewer.json5")


def test_clients_do_believe_the_server(folder: KeyFolder) -> None:
    """Else the impostors would fail for another reason."""
    endpoint = free_tls_endpoint()
    with impostor(folder, endpoint, {"listen__endpoints": [endpoint]}):
        triquad_client.connect(endpoint, config=folder.path / "viewer.json5").close()


@contextmanager
def impostor(folder: KeyFolder, endpoint: str, changes: dict[str, Any]) -> Iterator[None]:
    """Somebody who listens and says that he has the map."""
    with opened(folder.path / "server.json5", None, **changes) as session:
        token = session.liveliness().declare_token(keys.alive_key("default", "x"))
        yield
        token.undeclare()


def test_nodes_of_ros_take_part_in_their_domain_alone(folder: KeyFolder) -> None:
    file = folder.add(Holder("others", ROBOT, ros2_domain=3), DAYS)
    endpoint = free_tls_endpoint()
    received: list[zenoh.Sample] = []
    listens = {"listen__endpoints": [endpoint], "access_control__enabled": True}
    with (
        opened(folder.path / "server.json5", None, **listens) as server,
        opened(file, endpoint) as nodes,
    ):
        inbox = zenoh.handlers.Callback(received.append, indirect=False)
        server.declare_subscriber("*/**", inbox)
        answer = server.declare_queryable("3/add/**", lambda query: query.reply("3/add", b""))
        for key in ("4/lidar", "triquad/default/scan/roof", "3/lidar"):
            nodes.put(key, b"")
        tokens = [nodes.liveliness().declare_token(f"@ros2_lv/{n}/node") for n in (3, 4)]
        assert list(nodes.get("3/add", timeout=WAIT_S))
        found = server.liveliness().get("@ros2_lv/**", timeout=WAIT_S)
        assert [str(reply.ok.key_expr) for reply in found] == ["@ros2_lv/3/node"]
        assert [str(sample.key_expr) for sample in received] == ["3/lidar"]
        answer.undeclare()
        for token in tokens:
            token.undeclare()


@pytest.mark.parametrize("path", PATHS)
def test_a_robot_with_ros_is_mapped(network: Network, path: str) -> None:
    messages = RosMessages()
    with (
        bridging(network.endpoints["server"], "--config", network.file("bridge")) as bridged,
        opened(network.file("nodes"), network.endpoints[path]) as session,
    ):
        robot = Robot(session, RmwZenoh(session, messages), messages)
        robot.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(robot, 0, 1)
        robot.cloud(0.1, sphere(), topic=f"/{path}")
        bridged.wait_for(lambda: bridged.taken == 1)


def test_tools_come_with_credentials(network: Network, capsys: pytest.CaptureFixture[str]) -> None:
    endpoint, viewer = network.endpoints["router"], str(network.file("viewer"))
    once = ["--once", "--json", "--interval", "0.1", "--connect", endpoint]
    assert top.main([*once, "--config", viewer]) == OK
    assert json.loads(capsys.readouterr().out)["map"] == "default"
    assert inspect.main([endpoint, "--json", "--config", viewer]) == OK
    assert json.loads(capsys.readouterr().out)["map"] == "default"
    assert top.main([*once, "--config", str(network.file("removed"))]) == FAILED
    assert "no server has a map 'default'" in capsys.readouterr().err


def test_servers_share_a_map_behind_a_router(network: Network, tmp_path: Path) -> None:
    router = ["--connect", network.endpoints["router"]]
    words = ["--config", network.file("server"), "--settings", SMALL_FILE, *router]
    words += ["--map", "town", "--share", "--store", tmp_path]
    with ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(server_process(words, free_tls_endpoint()))
        robot, viewer, admin = (
            stack.enter_context(
                triquad_client.connect(
                    network.endpoints["router"], "town", config=network.file(who)
                )
            )
            for who in ("robot", "viewer", "admin")
        )
        places = [shifted(6.0 * number) for number in range(12)]
        for pose in places:
            robot.publish_scan(sphere(), pose, source=OWN)
        assert robot.flush(WAIT_S).lost == 0
        connection = viewer._connection
        assert isinstance(connection, SharedConnection)
        owners = {one for holders in connection.shares.leases.values() for one in holders}
        assert owners == {1, 2}
        for pose in places:
            found = viewer.query_sdf(sphere(100) + pose[:3, 3])
            assert (found.status == Status.SURFACE).mean() > 0.9
        assert admin.checkpoint().bytes > 0
        with pytest.raises(NoReplyError):
            viewer.checkpoint()
        forged = lease_key("town", 1, (0, 0, 0), 1)
        with network.session("robot", "router") as hostile:
            token = hostile.liveliness().declare_token(forged)
            assert viewer.status().regions > 0
            assert 1 not in connection.shares.holders((0, 0, 0)).values()
            del token
