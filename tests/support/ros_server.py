"""Servers that listen to ROS 2, and what tests wait for in their status."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import triquad_client
from support import servers
from support.ros_robot import Robot, shifted
from triquad_client import Client, ServerStatus
from triquad_server.settings import Ros2Settings, SourceSettings

AT = (20.0, -3.0, 1.0)  # of the robot in the map
MAST = shifted(z=0.5)  # of the lidar on the robot


@contextmanager
def serving(
    connect: tuple[str, ...] = (),
    sources: dict[str, SourceSettings] | None = None,
    **ros2: object,
) -> Iterator[tuple[str, Client]]:
    """A server that listens to ROS 2, and a client of it."""
    update = {"ros2": Ros2Settings(enabled=True, **ros2), "sources": sources or {}}
    with (
        servers.running_service(
            servers.SMALL.model_copy(update=update), connect=connect
        ) as endpoint,
        triquad_client.connect(endpoint) as client,
    ):
        yield endpoint, client


def until(client: Client, holds: Callable[[ServerStatus], bool]) -> ServerStatus:
    """The server's status, once something holds of it."""
    deadline = time.monotonic() + servers.WAIT_S
    while not holds(status := client.status()):
        assert time.monotonic() < deadline, status
        time.sleep(0.02)
    return status


def accounted(status: ServerStatus) -> int:
    return status.scans_taken + sum(status.scans_dropped.values())


def stand(robot: Robot, *seconds: float) -> None:
    """The robot stands where it is, at several times."""
    for second in seconds:
        robot.tf(second, ("map", "odom", shifted()), ("odom", "base_link", shifted(*AT)))
