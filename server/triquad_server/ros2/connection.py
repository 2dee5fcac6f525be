"""The connection of a server with ROS 2: what it takes in there, and what it publishes."""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Protocol, TypeVar

import zenoh
from triquad_map.compiled.team import Team
from triquad_tools.sensors.ros.type_store import MARKER, OCCUPANCY_GRID

from triquad_server.epochs.history import EpochHistory
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.mesh.tile_feed import TileFeed
from triquad_server.ros2.intake.feeds import full_name, prefix_of
from triquad_server.ros2.intake.ros2_intake import Ros2Intake
from triquad_server.ros2.node import Node
from triquad_server.ros2.output.grid_outlet import GridOutlet, SliceShape
from triquad_server.ros2.output.mesh_outlet import MeshOutlet
from triquad_server.ros2.output.outlet import Outlet
from triquad_server.ros2.topics import Delivery, Topic
from triquad_server.settings import Ros2Settings

_log = logging.getLogger("triquad_server.ros2")


class _Part(Protocol):
    """What has to be closed."""

    def close(self) -> None:
        """End it."""


_PartT = TypeVar("_PartT", bound=_Part)

_MESH_DELIVERY = Delivery(depth=100)
_GRID_DELIVERY = Delivery(latched=True, depth=1)  # as Nav2 expects of a map


@dataclass(frozen=True)
class ServedParts:
    """The parts of a server that the connection needs."""

    scans: ScanQueue
    scan_arrived: Callable[[], None]  # to be called after each that was queued
    max_points: int  # of a scan
    epochs: EpochHistory
    tiles: TileFeed
    team: Team  # for work that nobody waits for


class Ros2Connection:
    """All that connects a server with ROS 2, until it is closed."""

    def __init__(self, session: zenoh.Session, settings: Ros2Settings, parts: ServedParts) -> None:
        self._session = session
        self._settings = settings
        self._open = ExitStack()
        below = f" below {settings.namespace}" if settings.namespace else ""
        _log.info("ros2: listening in domain %d%s", settings.domain, below)
        try:
            self._node = self._keep(Node(session, settings.domain))
            self._intake = self._keep(
                Ros2Intake(
                    session,
                    settings,
                    parts.scans,
                    max_points=parts.max_points,
                    arrived=parts.scan_arrived,
                    node=self._node,
                )
            )
            self._open_mesh(parts)
            self._open_grid(parts)
        except BaseException:
            self._open.close()
            raise

    def close(self) -> None:
        """Take in and publish no more."""
        self._open.close()

    def _open_mesh(self, parts: ServedParts) -> None:
        outlet = self._outlet(self._settings.mesh_topic, MARKER, _MESH_DELIVERY)
        if outlet is not None:
            self._keep(
                MeshOutlet(
                    outlet,
                    parts.tiles,
                    level=self._settings.mesh_level,
                    bytes_per_s=self._settings.mesh_bytes_per_s,
                    place=lambda: self._intake.place,
                )
            )

    def _open_grid(self, parts: ServedParts) -> None:
        outlet = self._outlet(self._settings.grid_topic, OCCUPANCY_GRID, _GRID_DELIVERY)
        if outlet is not None:
            self._keep(
                GridOutlet(
                    outlet,
                    parts.epochs,
                    SliceShape.of_settings(self._settings),
                    period_s=self._settings.grid_period_s,
                    team=parts.team,
                    place=lambda: self._intake.place,
                )
            )

    def _outlet(self, name: str, type_name: str, delivery: Delivery) -> Outlet | None:
        """A topic to publish on; None where it has no name."""
        if not name:
            return None
        topic = Topic(full_name(prefix_of(self._settings), name), type_name)
        outlet = Outlet(
            self._session, self._node, topic, domain=self._settings.domain, delivery=delivery
        )
        return self._keep(outlet)

    def _keep(self, part: _PartT) -> _PartT:
        """A part that is closed with the connection."""
        self._open.callback(part.close)
        return part
