"""What a recording of ROS holds, found in one pass over it."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

from rosbags.interfaces import Connection
from triquad_format.errors import InvalidInputError

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.bag import Bag, Message
from triquad_tools.sensors.motion.frame_tree import STATIC, FrameTree, Track, Transform
from triquad_tools.sensors.ray_check import RayCheck
from triquad_tools.sensors.ros import type_store
from triquad_tools.sensors.ros.depth_camera import is_depth
from triquad_tools.sensors.ros.message_reader import MessageReader
from triquad_tools.sensors.sweep import NoScanError

_TRANSFORMS = (type_store.TF, type_store.TF_OF_ROS_1)
_POSES = (type_store.ODOMETRY, type_store.POSE)
_SCANS = (type_store.POINT_CLOUD, type_store.IMAGE)
_USED = (type_store.CAMERA_INFO, *_TRANSFORMS, *_POSES, *_SCANS)


@dataclass(frozen=True)
class SeenCloud:
    """A cloud or depth image whose points were checked, but not kept."""

    topic: str
    number: int  # of the messages on its topic
    frame: str = ""
    stamp_ns: int = 0
    first_ns: int = 0  # when its first point was measured
    last_ns: int = 0
    problem: NoScanError | None = None  # why no scan can be made of it


@dataclass
class PoseTopic:
    """Poses of one topic, which may not say whose they are."""

    parent: str = ""
    child: str = ""
    track: Track = field(default_factory=Track)


class RosContent:
    """The clouds, poses and cameras of a bag.

    ``kinds`` and ``counts`` are the types and numbers of messages by topic, ``clouds`` are in the
    order of their recording, and ``broken`` says by topic what is wrong with its poses.
    """

    def __init__(self, bag: Bag, reader: MessageReader) -> None:
        """Read all of a bag.

        Raises:
            ToolError: it is damaged.
        """
        self.kinds: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.clouds: list[SeenCloud] = []
        self.rays = RayCheck()
        self.frames = FrameTree()
        self.poses: dict[str, PoseTopic] = defaultdict(PoseTopic)
        self.broken: dict[str, list[str]] = defaultdict(list)
        self.missing = 0  # messages that its index names, but that could not be read
        self._colours: set[str] = set()  # topics of images that hold no depth
        self._numbers: Counter[str] = Counter()
        self._reader = reader
        total = 0
        for connection in bag.connections():
            self.kinds[connection.topic] = connection.msgtype
            self.counts[connection.topic] += connection.msgcount
            total += connection.msgcount if connection.msgtype in _USED else 0
        # Cameras first: an image may come before what is known of its camera.
        messages = bag.messages(
            _is_camera, lambda one: one.msgtype in _USED and not _is_camera(one)
        )
        done = 0
        with progress("looking through the recording", total) as report:
            for done, message in enumerate(messages, start=1):
                if message.topic not in self._colours:
                    self._take(message, message.decoded())
                report(done, f"{done} of {total} messages")
        self.missing = total - done

    def _take(self, message: Message, decoded: Any) -> None:
        topic, kind = message.topic, message.kind
        try:
            if kind == type_store.CAMERA_INFO:
                self._reader.cameras[topic] = decoded
            elif kind in (*_TRANSFORMS, *_POSES):
                static, came_ns = topic.endswith("tf_static"), message.recorded_ns
                for each in self._reader.transforms(kind, decoded, came_ns, static=static):
                    self._add(topic, each, is_pose=kind in _POSES)
            elif kind == type_store.IMAGE and not is_depth(decoded.encoding):
                self._colours.add(topic)
            else:
                self._add_cloud(message, decoded)
        except AttributeError as error:  # a bag brings its own definitions of types
            raise ToolError(f"{topic}: messages are not as {kind} is defined: {error}") from error

    def _add_cloud(self, message: Message, decoded: Any) -> None:
        topic = message.topic
        number = self._numbers[topic]
        self._numbers[topic] += 1
        try:
            sweep = self._reader.sweep(topic, message.kind, decoded, message.recorded_ns)
        except NoScanError as error:
            self.clouds.append(SeenCloud(topic, number, problem=error))
            return
        if message.kind != type_store.IMAGE:
            self.rays.see(topic, sweep.points)
        first_ns, last_ns = sweep.span_ns
        self.clouds.append(SeenCloud(topic, number, sweep.frame, sweep.stamp_ns, first_ns, last_ns))

    def _add(self, topic: str, transform: Transform, *, is_pose: bool) -> None:
        """Add a transform to all, or a pose to those of its topic."""
        try:
            if not is_pose:
                self.frames.add(transform)
                return
            position, quaternion = transform.pose.numbers()
        except InvalidInputError as error:
            self.broken[topic].append(str(error))
            return
        known = self.poses[topic]
        known.parent, known.child = transform.parent, transform.child
        assert transform.stamp_ns is not STATIC
        known.track.add(transform.stamp_ns, position, quaternion)


def _is_camera(connection: Connection) -> bool:
    return connection.msgtype == type_store.CAMERA_INFO
