"""Bridges to ROS 2 in this process, over a server of the test, and what tests wait for."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import triquad_client
from support import servers
from support.poses import shifted
from support.ros.ros_robot import Robot
from triquad_client import Client, ServerStatus
from triquad_tools.commands import ros2
from triquad_tools.ros2 import bridge
from triquad_tools.ros2.bridge import open_session
from triquad_tools.ros2.intake.intake import Intake
from triquad_tools.work.ros2 import bridge_options

AT = (20.0, -3.0, 1.0)  # of the robot in the map
MAST = shifted(z=0.5)  # of the lidar on the robot


@dataclass(frozen=True)
class Bridged:
    """A bridge, and the server that it publishes to."""

    endpoint: str  # where robots and clients connect to
    client: Client
    bridge: Intake
    before: ServerStatus  # of the server, when the bridge began

    @property
    def taken(self) -> int:
        """Scans that the server took into the map since then."""
        return self.client.status().scans_taken - self.before.scans_taken

    @property
    def lost(self) -> int:
        """Scans that the server lost since then."""
        now, before = (sum(s.scans_lost.values()) for s in (self.client.status(), self.before))
        return now - before

    @property
    def accounted(self) -> int:
        """Scans that were taken, or dropped by the bridge."""
        return self.taken + sum(self.bridge.dropped.values())

    def wait_for(self, holds: Callable[[], bool]) -> None:
        """Return once something holds."""
        bridge = self.bridge
        servers.until(holds, lambda: (bridge.published, bridge.dropped, self.client.status()))

    def send_until(self, send: Callable[[int], None], holds: Callable[[], bool]) -> None:
        """Send with ever higher numbers until something holds: what is first may not be heard."""
        numbers = itertools.count(1)

        def holds_now() -> bool:
            if not holds():
                send(next(numbers))
            return holds()

        self.wait_for(holds_now)

    def settle(self) -> None:
        self.wait_for(lambda: self.client.status().settled)


@contextmanager
def bridging(endpoint: str, *arguments: object, router: str | None = None) -> Iterator[Bridged]:
    """A bridge with these arguments of its command, to a server whose map is emptied before.

    Nodes are at the server, or at a ``router``.
    """
    parsed = ros2.parser().parse_args(list(map(str, arguments)))
    file: Path | None = parsed.config
    with (
        triquad_client.connect(endpoint, config=file) as client,
        closing(open_session(router or endpoint, file)) as session,
    ):
        if client.status().scans_taken and file is None:
            client.reset()
        before = client.status()
        with bridge.bridging(session, client, bridge_options(parsed)) as intake:
            # Once this is answered, the router knows all subscriptions.
            list(session.liveliness().get("@ros2_lv/**", timeout=servers.WAIT_S))
            yield Bridged(router or endpoint, client, intake, before)


def stand(robot: Robot, *seconds: float) -> None:
    """The robot stands where it is, at several times, with the lidar on its mast."""
    robot.tf(0, ("base_link", "lidar", MAST), static=True)
    for second in seconds:
        robot.tf(second, ("map", "odom", shifted()), ("odom", "base_link", shifted(*AT)))
