"""``triquad-ros2 --serve``: one command serves a map and bridges robots to it."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import triquad_client
import zenoh
from support import servers
from support.attackers.beyond import from_beyond
from support.ros.ros_bridge import stand
from support.ros.ros_robot import robot
from triquad_client import NoReplyError
from triquad_format.wire import codec, keys
from triquad_format.wire.status_messages import StatusRequest


@contextmanager
def one_command(folder: Path, listen: str, *arguments: str) -> Iterator[servers.ServerProcess]:
    """``triquad-ros2 --serve``, once it listens to nodes."""
    files = ["--settings", servers.SMALL_FILE, "--store", folder / "maps"]
    program = ["-m", "triquad_tools.commands.ros2", *arguments, "--serve"]
    serving = servers.server_process(["--map", "yard", *files], listen, False, program=program)
    with serving as both:
        both.wait_for("ros2: listening in domain 0")
        yield both


def test_one_command_serves_a_map_and_bridges(tmp_path: Path) -> None:
    """It says what it maps, is stopped by SIGTERM, and what it mapped is in the store."""
    endpoint = servers.free_endpoint()
    (tmp_path / "ros2.args").write_text("--clouds\n/points\n--wait-s=30\n")
    with one_command(tmp_path, endpoint, f"@{tmp_path / 'ros2.args'}") as both:
        with robot(endpoint, mode="peer") as r2:
            stand(r2, 0, 1)
            r2.cloud(0.5, servers.sphere())
            both.wait_for("ros2: mapping in the frame 'map'")
        with triquad_client.connect(endpoint, "yard") as client:
            while client.status().scans_taken == 0:
                assert both.process.poll() is None
        both.process.send_signal(signal.SIGTERM)
        assert both.wait() == 0
    assert "ros2: found /points (sensor_msgs/msg/PointCloud2)" in both.log
    assert "ros2: 1 scans published, dropped: none" in both.log
    assert list((tmp_path / "maps" / "yard").iterdir())


def test_nodes_beyond_this_machine_take_part_but_do_not_change_the_map(tmp_path: Path) -> None:
    listen = servers.free_endpoint().replace("127.0.0.1", "0.0.0.0")
    beyond = from_beyond(listen)
    with one_command(tmp_path, listen) as both:
        with robot(beyond) as r2:
            stand(r2, 0, 1)
            r2.cloud(0.5, servers.sphere())
            both.wait_for("ros2: mapping in the frame 'map'")
        with triquad_client.connect(beyond, "yard") as client:
            assert client.status().epoch > 0
            with pytest.raises(NoReplyError, match="access control"):
                client.reset()
        nearby = listen.replace("0.0.0.0", "127.0.0.1")
        with (
            servers.raw_session(connect=nearby) as here,
            servers.raw_session(connect=beyond) as there,
        ):
            assert_passes_for_no_server(there, here)
        both.process.kill()
        assert both.wait() == -signal.SIGKILL
    assert "INFO stopped" in both.log, "the server ends with the command that started it"


def assert_passes_for_no_server(there: zenoh.Session, here: zenoh.Session) -> None:
    """Who is not here publishes on any key but as the server, and receives no scans of others."""
    heard = here.declare_subscriber("**")
    scans = there.declare_subscriber("triquad/yard/scan/*")
    mesh = there.declare_subscriber("triquad/mesh")
    for session in (here, there):  # the subscriptions are known from here on
        assert servers.RawPeer(session, "yard").ask(keys.STATUS, codec.encode(StatusRequest()))
    for key in ("triquad/yard/status", "roof/points", "0/points/t/h", "last"):
        there.put(key, b"theirs", congestion_control=zenoh.CongestionControl.BLOCK)
    received: list[str] = []
    while "last" not in received:
        sample = heard.recv()
        received += [str(sample.key_expr)] if sample.payload.to_bytes() == b"theirs" else []
    assert received == ["roof/points", "0/points/t/h", "last"]
    for key in ("triquad/yard/scan/a", "triquad/mesh"):
        here.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
    assert str(mesh.recv().key_expr) == "triquad/mesh"
    assert scans.try_recv() is None
