"""The topics that are received, their roles, and the keys of Zenoh for their messages."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from triquad_tools.ros2.topics import Topic, bridge_key, rmw_key
from triquad_tools.sensors.ros.depth_camera import camera_topic
from triquad_tools.sensors.ros.type_store import (
    CAMERA_INFO,
    IMAGE,
    ODOMETRY,
    POINT_CLOUD,
    POSE,
    TF,
)

TF_POSES = "tf"
"""Stands for transforms in place of a topic of poses."""


class Role(Enum):
    """The role of messages."""

    CLOUD = "cloud"
    DEPTH = "depth image"
    CAMERA_INFO = "camera info"
    TF = "transforms"
    TF_STATIC = "static transforms"
    POSE = "pose"

    @property
    def brings_scans(self) -> bool:
        """Whether a scan is made of each message; others say something about scans."""
        return self in (Role.CLOUD, Role.DEPTH)


TYPES: dict[Role, tuple[str, ...]] = {
    Role.CLOUD: (POINT_CLOUD,),
    Role.DEPTH: (IMAGE,),
    Role.CAMERA_INFO: (CAMERA_INFO,),
    Role.TF: (TF,),
    Role.TF_STATIC: (TF,),
    Role.POSE: (ODOMETRY, POSE),
}
"""The types that messages may have."""


@dataclass(frozen=True)
class Feed:
    """A key expression and what comes on it."""

    role: Role
    key: str
    topic_name: str | None  # None: each key of rmw_zenoh names its own


@dataclass(frozen=True)
class TopicChoice:
    """The topics that are wanted, by their full names."""

    domain: int = 0
    prefix: str = ""  # of all names: "", or with a leading slash
    clouds: tuple[str, ...] = ()  # (): all that there are, or none where there are depth images
    depth: tuple[str, ...] = ()
    poses: str | None = None  # None: from transforms

    @classmethod
    def named(
        cls, domain: int, namespace: str, *, clouds: list[str], depth: list[str], poses: str
    ) -> "TopicChoice":
        """Return the choice of names below a namespace, all with or without leading slashes."""
        prefix = full_name("", namespace).rstrip("/")
        return cls(
            domain,
            prefix,
            clouds=tuple(full_name(prefix, name) for name in clouds),
            depth=tuple(full_name(prefix, name) for name in depth),
            poses=None if poses.strip("/") == TF_POSES else full_name(prefix, poses),
        )

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
                    yield Feed(role, rmw_key(self.domain, Topic(name, type_name)), name)
                yield Feed(role, bridge_key(name), name)
        if self.takes_any_cloud:
            anywhere = Topic(f"{self.prefix}/**", POINT_CLOUD)
            yield Feed(Role.CLOUD, rmw_key(self.domain, anywhere), None)

    def wants(self, topic: Topic) -> Role | None:
        """Return the role of a topic that was found."""
        for role, names in self._names().items():
            if topic.name in names and topic.type_name in TYPES[role]:
                return role
        is_cloud = topic.type_name == POINT_CLOUD and topic.name.startswith(f"{self.prefix}/")
        return Role.CLOUD if is_cloud and self.takes_any_cloud else None

    def _names(self) -> dict[Role, tuple[str, ...]]:
        """Return the topics whose names are known."""
        infos = tuple(camera_topic(name) for name in self.depth)
        names = {
            Role.CLOUD: self.clouds,
            Role.DEPTH: self.depth,
            Role.CAMERA_INFO: tuple(dict.fromkeys(infos)),
            Role.TF_STATIC: (f"{self.prefix}/tf_static",),
        }
        if self.poses is None:
            return {**names, Role.TF: (f"{self.prefix}/tf",)}
        return {**names, Role.POSE: (self.poses,)}


def full_name(prefix: str, name: str) -> str:
    """Return a topic's name with a leading slash, behind ``prefix``."""
    return f"{prefix}/{name.strip('/')}"
