"""``triquad-ros2 --serve``: one command serves a map and bridges robots to it."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import triquad_client
from support import servers
from support.attackers.beyond import from_beyond
from support.ros.ros_bridge import stand
from support.ros.ros_robot import robot
from triquad_client import NoReplyError


@contextmanager
def one_command(folder: Path, listen: str, *arguments: str) -> Iterator[servers.ServerProcess]:
    """``triquad-ros2 --serve``, once it listens to nodes; stopped at the end if it still runs."""
    servers.compiled()
    (folder / "server.toml").write_text(servers.SMALL_TOML)
    command = [sys.executable, "-m", "triquad_tools.commands.ros2", *arguments]
    command += ["--serve", "--listen", listen, "--settings", str(folder / "server.toml")]
    command += ["--store", str(folder / "maps"), "--device", "cpu", "--map", "yard"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        both = servers.ServerProcess(process, listen)
        try:
            both.wait_for("ros2: listening in domain 0")
            yield both
        finally:
            process.terminate()
            both.wait()


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
        both.process.kill()
        assert both.wait() == -signal.SIGKILL
    assert "INFO stopped" in both.log, "the server ends with the command that started it"
