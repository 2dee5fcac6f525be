"""What a recording of ROS holds, found in one pass over it."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

from triquad_format.errors import InvalidInputError

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.bag import Bag, Message
from triquad_tools.sensors.errors import NoScanError
from triquad_tools.sensors.motion.frame_tree import STATIC, FrameTree, Transform
from triquad_tools.sensors.motion.track import Track
from triquad_tools.sensors.ros import type_store
from triquad_tools.sensors.ros.depth_camera import camera_topic, is_depth, sweep_of_depth
from triquad_tools.sensors.ros.point_cloud import sweep_of_cloud
from triquad_tools.sensors.ros.transforms import (
    transform_of_odometry,
    transform_of_pose,
    transforms_of_tf,
)
from triquad_tools.sensors.sweep import Sweep

_SCANS = (type_store.POINT_CLOUD, type_store.IMAGE)
_TRANSFORMS = (type_store.TF, type_store.TF_OF_ROS_1)
_POSES = (type_store.ODOMETRY, type_store.POSE)


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

    def __init__(self, bag: Bag, *, recorder_clock: bool) -> None:
        """Read all of a bag; with ``recorder_clock``, stamps are when messages were recorded.

        Raises:
            ToolError: it is damaged.
        """
        self.kinds: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.clouds: list[SeenCloud] = []
        self.frames = FrameTree()
        self.poses: dict[str, PoseTopic] = defaultdict(PoseTopic)
        self.broken: dict[str, list[str]] = defaultdict(list)
        self.missing = 0  # messages that its index names, but that could not be read
        self._cameras: dict[str, Any] = {}  # first CameraInfo by topic
        self._colours: set[str] = set()  # topics of images that hold no depth
        self._numbers: Counter[str] = Counter()
        self._recorder_clock = recorder_clock
        with bag.open() as opened:
            for connection in opened.connections:
                self.kinds[connection.topic] = connection.msgtype
                self.counts[connection.topic] += connection.msgcount
            # Cameras first: an image may come before what is known of its camera.
            cameras = [c for c in opened.connections if c.msgtype == type_store.CAMERA_INFO]
            others = [
                c for c in opened.connections if c.msgtype in (*_SCANS, *_TRANSFORMS, *_POSES)
            ]
            total = sum(connection.msgcount for connection in (*cameras, *others))
            messages = chain(opened.messages(cameras), opened.messages(others))
            done = 0
            with progress("looking through the recording", total) as report:
                for done, message in enumerate(messages, start=1):
                    if message.connection.topic not in self._colours:
                        self._take(message, opened.decode(message))
                    report(done, f"{done} of {total} messages")
            self.missing = total - done

    def sweep(self, message: Message, decoded: Any, stride: int = 1) -> Sweep:
        """Return the sweep of a cloud or a depth image.

        Raises:
            NoScanError: it is none, or what is known of its camera was not recorded.
        """
        if message.connection.msgtype == type_store.POINT_CLOUD:
            sweep = sweep_of_cloud(decoded)
        else:
            camera = camera_topic(message.connection.topic)
            if camera not in self._cameras:
                there = ", ".join(sorted(self._cameras)) or "none"
                raise NoScanError(
                    "no_camera_info",
                    f"{camera} was not recorded (of that kind there is {there}): record it",
                )
            sweep = sweep_of_depth(decoded, self._cameras[camera], stride)
        return replace(sweep, stamp_ns=message.recorded_ns) if self._recorder_clock else sweep

    def _take(self, message: Message, decoded: Any) -> None:
        topic, kind = message.connection.topic, message.connection.msgtype
        try:
            if kind == type_store.CAMERA_INFO:
                self._cameras.setdefault(topic, decoded)
            elif kind in _TRANSFORMS:
                for transform in transforms_of_tf(decoded, static=topic.endswith("tf_static")):
                    self._add_transform(message, transform)
            elif kind in _POSES:
                of_body = kind == type_store.ODOMETRY
                read = transform_of_odometry if of_body else transform_of_pose
                self._add_pose(message, read(decoded))
            elif kind == type_store.IMAGE and not is_depth(decoded.encoding):
                self._colours.add(topic)
            else:
                self._add_cloud(message, decoded)
        except AttributeError as error:  # a bag brings its own definitions of types
            raise ToolError(f"{topic}: messages are not as {kind} is defined: {error}") from error

    def _add_cloud(self, message: Message, decoded: Any) -> None:
        topic = message.connection.topic
        number = self._numbers[topic]
        self._numbers[topic] += 1
        try:
            sweep = self.sweep(message, decoded)
        except NoScanError as error:
            self.clouds.append(SeenCloud(topic, number, problem=error))
            return
        first_ns, last_ns = sweep.span_ns
        self.clouds.append(SeenCloud(topic, number, sweep.frame, sweep.stamp_ns, first_ns, last_ns))

    def _add_transform(self, message: Message, transform: Transform) -> None:
        try:
            self.frames.add(self._timed(transform, message))
        except InvalidInputError as error:
            self.broken[message.connection.topic].append(str(error))

    def _add_pose(self, message: Message, transform: Transform) -> None:
        topic, timed = message.connection.topic, self._timed(transform, message)
        try:
            position, quaternion = timed.pose.numbers()
        except InvalidInputError as error:
            self.broken[topic].append(str(error))
            return
        known = self.poses[topic]
        known.parent, known.child = timed.parent, timed.child
        assert timed.stamp_ns is not STATIC
        known.track.add(timed.stamp_ns, position, quaternion)

    def _timed(self, transform: Transform, message: Message) -> Transform:
        if not self._recorder_clock or transform.stamp_ns is STATIC:
            return transform
        return replace(transform, stamp_ns=message.recorded_ns)
