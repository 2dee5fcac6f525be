"""Options of the bridge: which topics are received and as what, and what is published."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from triquad_client import Bounds
from triquad_format.records.arrays import Doubles

from triquad_tools.console.arguments import Place
from triquad_tools.ros2.topics import Topic, bridge_key, rmw_key
from triquad_tools.sensors.ros import type_store as types
from triquad_tools.sensors.ros.depth_camera import camera_topic

MAX_GRID_CELLS = 250_000


class Role(Enum):
    """The role of messages."""

    CLOUD = "cloud"
    DEPTH = "depth image"
    CAMERA_INFO = "camera info"
    TF = "transforms"
    TF_STATIC = "static transforms"
    POSE = "pose"
    CORRECTION = "corrected path"

    @property
    def brings_scans(self) -> bool:
        """Whether a scan is made of each message; others say something about scans."""
        return self in (Role.CLOUD, Role.DEPTH)


TYPES: dict[Role, tuple[str, ...]] = {
    Role.CLOUD: types.CLOUDS,
    Role.DEPTH: types.IMAGES,
    Role.CAMERA_INFO: (types.CAMERA_INFO,),
    Role.TF: (types.TF,),
    Role.TF_STATIC: (types.TF,),
    Role.POSE: types.POSES,
    Role.CORRECTION: (types.PATH,),
}
"""The types that messages may have."""


@dataclass(frozen=True)
class Feed:
    """A key expression and what comes on it."""

    role: Role
    key: str
    topic_name: str | None  # None: each key of rmw_zenoh names its own
    type_name: str = ""  # where it is known


@dataclass(frozen=True)
class TopicChoice:
    """The topics that are wanted, by their full names."""

    domain: int = 0
    prefix: str = ""  # of all names: "", or with a leading slash
    clouds: tuple[str, ...] = ()  # (): all that there are, or none where there are depth images
    depth: tuple[str, ...] = ()
    poses: str | None = None  # None: from transforms
    odometry: str | None = None  # of clouds that poses are found from
    corrections: str | None = None  # a path of poses as they are known by now, or ALL_TF: jumps

    @property
    def takes_any_cloud(self) -> bool:
        """Whether all clouds are wanted: a depth camera publishes what it sees as clouds too."""
        return not self.clouds and not self.depth

    @property
    def mesh(self) -> str:
        """The topic on which the mesh is published."""
        return full_name(self.prefix, "triquad/mesh")

    @property
    def grid(self) -> str:
        """The topic on which the occupancy grid is published."""
        return full_name(self.prefix, "triquad/grid")

    def feeds(self) -> Iterator[Feed]:
        """Return what to subscribe to from the start.

        Where clouds are not chosen, those of zenoh-bridge-ros2dds are found by their tokens, since
        their keys do not give types.
        """
        for role, names in self._names().items():
            for name in names:
                for type_name in TYPES[role]:
                    key = rmw_key(self.domain, Topic(name, type_name))
                    yield Feed(role, key, name, type_name)
                yield Feed(role, bridge_key(name), name)
        if self.takes_any_cloud:
            for type_name in TYPES[Role.CLOUD]:
                anywhere = Topic(f"{self.prefix}/**", type_name)
                yield Feed(Role.CLOUD, rmw_key(self.domain, anywhere), None, type_name)

    def wants(self, topic: Topic) -> Role | None:
        """Return the role of a topic that was found."""
        for role, names in self._names().items():
            if topic.name in names and topic.type_name in TYPES[role]:
                return role
        is_cloud = topic.type_name in TYPES[Role.CLOUD] and topic.name.startswith(f"{self.prefix}/")
        return Role.CLOUD if is_cloud and self.takes_any_cloud else None

    def _names(self) -> dict[Role, tuple[str, ...]]:
        infos = tuple(camera_topic(name) for name in self.depth)
        names = {
            Role.CLOUD: self.clouds,
            Role.DEPTH: self.depth,
            Role.CAMERA_INFO: tuple(dict.fromkeys(infos)),
            Role.TF_STATIC: (f"{self.prefix}/tf_static",),
        }
        if self.corrections not in (None, types.ALL_TF):
            names[Role.CORRECTION] = (self.corrections,)
        if self.poses is None:
            return {**names, Role.TF: (f"{self.prefix}/tf",)}
        return {**names, Role.POSE: (self.poses,)}


def full_name(prefix: str, name: str) -> str:
    """Return a topic's name with a leading slash, behind ``prefix``."""
    return f"{prefix}/{name.strip('/')}"


@dataclass(frozen=True)
class SliceShape:
    """The slice of the map that is published as an occupancy grid."""

    height_m: float  # in the map frame
    side_m: float
    cell_m: float

    @property
    def cells(self) -> int:
        """The cells along each side."""
        return max(1, round(self.side_m / self.cell_m))

    def around(self, position_m: Doubles) -> Bounds:
        """Return the corners of a flat box around a position [3], on a lattice that stays."""
        first = np.round(position_m[:2] / self.cell_m) - self.cells // 2
        low, high = first * self.cell_m, (first + self.cells) * self.cell_m
        return [*low.tolist(), self.height_m], [*high.tolist(), self.height_m]


@dataclass(frozen=True)
class BridgeOptions:
    """All options of the bridge."""

    topics: TopicChoice
    grid: SliceShape
    ray_origins: Mapping[str, Place]  # by topic, in the frame of its clouds; others are checked
    depth_stride: int  # every how many rows and columns of a depth image one is taken
    body_frame: str  # whose pose a topic of PoseStamped gives
    map_frame: str  # "": map, odom or world, the first that the transforms have
    clock: str  # stamps are when messages arrived ("arrival"), or those of their "header"
    wait_s: float  # for how long a scan waits for its transforms
    close_loops: bool  # odometry takes into account that it comes back to places
    mesh_level: int  # of detail: cells are twice as large at each
    mesh_bytes_per_s: int  # of markers, at most
