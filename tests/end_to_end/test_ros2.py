"""Robots with ROS 2 and a server, over Zenoh: clouds and poses in, a map to ask."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import triquad_client
from support import servers
from support.ros_robot import Robot, robot, shifted
from triquad_client import Client, ServerStatus, Status

WAYS = ["rmw", "bridge"]
AT = (20.0, -3.0, 1.0)  # of the robot in the map
MAST = shifted(z=0.5)  # of the lidar on the robot


@contextmanager
def serving(**ros2: object) -> Iterator[tuple[str, Client]]:
    """A server that listens to ROS 2, and a client of it."""
    settings = servers.SMALL.model_copy(
        update={"ros2": servers.SMALL.ros2.model_copy(update={"enabled": True, **ros2})}
    )
    with (
        servers.running_service(settings) as endpoint,
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


def finds_sphere(client: Client, centre: tuple[float, float, float]) -> bool:
    """Whether the map has the sphere that the lidar sees around it."""
    until(client, lambda status: status.settled)
    answer = client.query_sdf(np.array(centre) + servers.sphere(500))
    is_surface = answer.status == Status.SURFACE
    return bool(is_surface.mean() > 0.95 and np.abs(answer.sdf).mean() < 0.1)


@pytest.mark.parametrize("way", WAYS)
def test_clouds_and_transforms_become_a_map(way: str) -> None:
    with serving() as (endpoint, client), robot(endpoint, way) as r2:
        r2.tf(0, ("base_link", "lidar", MAST), static=True)
        stand(r2, 0, 1)
        for number in range(4):
            r2.cloud(0.2 * number + 0.1, servers.sphere())
        status = until(client, lambda status: accounted(status) == 4)
        assert status.scans_taken == 4, status
        assert finds_sphere(client, (AT[0], AT[1], AT[2] + 0.5))
