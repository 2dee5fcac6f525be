"""Which keys of Zenoh are listened to, and what each brings."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from triquad_tools.sensors.ros.depth_camera import camera_topic
from triquad_tools.sensors.ros.type_store import (
    CAMERA_INFO,
    IMAGE,
    ODOMETRY,
    POINT_CLOUD,
    POSE,
    TF,
)

from triquad_server.ros2.topics import Topic, bridge_key, rmw_key
from triquad_server.settings import Ros2Settings
from triquad_server.settings.ros2 import TF_POSES


class Role(Enum):
    """What messages are for."""

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
"""Of which type messages may be."""


@dataclass(frozen=True)
class Feed:
    """A key expression and what comes on it."""

    role: Role
    key: str
    topic_name: str | None  # None: each key of rmw_zenoh names its own


@dataclass(frozen=True)
class Choice:
    """The topics that are wanted, by their full names."""

    domain: int
    prefix: str  # of all names, "" or with a leading slash
    clouds: tuple[str, ...]  # (): all that there are, or none beside depth images
    depth: tuple[str, ...]
    poses: str | None  # None: from transforms

    @classmethod
    def of_settings(cls, settings: Ros2Settings) -> "Choice":
        """The choice that the settings make."""
        prefix = prefix_of(settings)
        poses = settings.poses
        return cls(
            settings.domain,
            prefix,
            clouds=tuple(full_name(prefix, name) for name in settings.clouds),
            depth=tuple(full_name(prefix, name) for name in settings.depth),
            poses=None if poses.strip("/") == TF_POSES else full_name(prefix, poses),
        )

    @property
    def takes_any_cloud(self) -> bool:
        """Whether all clouds are wanted: a depth camera publishes what it sees as clouds too."""
        return not self.clouds and not self.depth

    def feeds(self) -> Iterator[Feed]:
        """What to listen to from the start.

        Where clouds are not chosen, those of bridges are found by their tokens, since their keys
        do not tell types.
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
        """For what a topic that was found is wanted."""
        for role, names in self._names().items():
            if topic.name in names and topic.type_name in TYPES[role]:
                return role
        is_cloud = topic.type_name == POINT_CLOUD and topic.name.startswith(f"{self.prefix}/")
        return Role.CLOUD if is_cloud and self.takes_any_cloud else None

    def _names(self) -> dict[Role, tuple[str, ...]]:
        """The topics whose names are known."""
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


def prefix_of(settings: Ros2Settings) -> str:
    """What goes before all names: "", or the namespace with a leading slash."""
    return full_name("", settings.namespace).rstrip("/")


def full_name(prefix: str, name: str) -> str:
    """A topic's name with a leading slash, behind ``prefix``."""
    return f"{prefix}/{name.strip('/')}"
