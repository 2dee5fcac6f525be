"""The content of a recording of ROS, found in one pass over it."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from triquad_format.errors import InvalidInputError

from triquad_tools.console.command import ToolError
from triquad_tools.console.progress import progress
from triquad_tools.recordings.bag import Bag, Message, OpenBag
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

POSE_KINDS = (type_store.ODOMETRY, type_store.POSE)
_TF_KINDS = (type_store.TF, type_store.TF_OF_ROS_1)
_READ_KINDS = (type_store.POINT_CLOUD, type_store.IMAGE, type_store.CAMERA_INFO)


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

    kind: str
    parent: str = ""
    child: str = ""
    track: Track = field(default_factory=Track)


@dataclass
class Survey:
    """The content of a recording."""

    kinds: dict[str, str]  # type of the messages by topic
    counts: Counter[str] = field(default_factory=Counter)
    clouds: list[SeenCloud] = field(default_factory=list)  # in the order of their recording
    frames: FrameTree = field(default_factory=FrameTree)
    poses: dict[str, PoseTopic] = field(default_factory=dict)
    broken: dict[str, list[str]] = field(default_factory=dict)  # what is wrong with poses, by topic
    missing: int = 0  # messages that its index names, but that could not be read
    cameras: dict[str, Any] = field(default_factory=dict)  # first CameraInfo by topic


def survey(bag: Bag, *, recorder_clock: bool) -> Survey:
    """Check all of a bag.

    Raises:
        ToolError: it is damaged.
    """
    with bag.open() as opened:
        found = Survey({c.topic: c.msgtype for c in opened.connections})
        for connection in opened.connections:
            found.counts[connection.topic] += connection.msgcount
        kinds = {*_READ_KINDS, *POSE_KINDS, *_TF_KINDS}
        wanted = [c for c in opened.connections if c.msgtype in kinds]
        total = sum(connection.msgcount for connection in wanted)
        reader = _Reader(found, recorder_clock)
        with progress("looking through the recording", total) as report:
            # Cameras first: an image may come before what is known of its camera.
            cameras = [c for c in wanted if c.msgtype == type_store.CAMERA_INFO]
            others = [c for c in wanted if c.msgtype != type_store.CAMERA_INFO]
            messages = chain(opened.messages(cameras), opened.messages(others))
            done = 0
            for done, message in enumerate(messages, start=1):
                reader.take(opened, message)
                report(done, f"{done} of {total} messages")
        found.missing = total - done
    return found


def sweep_of_image(image: Any, topic: str, cameras: Mapping[str, Any], stride: int = 1) -> Sweep:
    """Return the sweep of a depth image that was recorded on ``topic``.

    Raises:
        NoScanError: it is none, or what is known of its camera was not recorded.
    """
    wanted = camera_topic(topic)
    if wanted not in cameras:
        there = ", ".join(sorted(cameras)) or "none"
        raise NoScanError(
            "no_camera_info",
            f"{wanted} was not recorded (of that kind there is {there}): record it",
        )
    return sweep_of_depth(image, cameras[wanted], stride)


class _Reader:
    """Reads messages by their types."""

    def __init__(self, found: Survey, recorder_clock: bool) -> None:
        self._found = found
        self._recorder_clock = recorder_clock
        self._numbers: Counter[str] = Counter()
        self._colours: set[str] = set()  # topics of images that hold no depth
        self._takers: dict[str, Callable[[Message, Any], None]] = {
            type_store.POINT_CLOUD: self._take_cloud,
            type_store.IMAGE: self._take_image,
            type_store.CAMERA_INFO: self._take_camera,
            type_store.ODOMETRY: self._take_pose,
            type_store.POSE: self._take_pose,
            **dict.fromkeys(_TF_KINDS, self._take_tf),
        }

    def take(self, opened: OpenBag, message: Message) -> None:
        topic, kind = message.connection.topic, message.connection.msgtype
        if topic in self._colours:
            return
        try:
            self._takers[kind](message, opened.decode(message))
        except AttributeError as error:  # a bag brings its own definitions of types
            raise ToolError(f"{topic}: messages are not as {kind} is defined: {error}") from error
        self._numbers[message.connection.topic] += 1

    def _take_cloud(self, message: Message, decoded: Any) -> None:
        self._add(message, lambda: sweep_of_cloud(decoded))

    def _take_image(self, message: Message, decoded: Any) -> None:
        topic = message.connection.topic
        if not is_depth(decoded.encoding):
            self._colours.add(topic)
            return
        self._add(message, lambda: sweep_of_image(decoded, topic, self._found.cameras))

    def _take_camera(self, message: Message, decoded: Any) -> None:
        self._found.cameras.setdefault(message.connection.topic, decoded)

    def _add(self, message: Message, make: Callable[[], Sweep]) -> None:
        topic = message.connection.topic
        number = self._numbers[topic]
        try:
            sweep = make()
        except NoScanError as error:
            self._found.clouds.append(SeenCloud(topic, number, problem=error))
            return
        stamp_ns = message.recorded_ns if self._recorder_clock else sweep.stamp_ns
        first_s = last_s = 0.0
        if sweep.offsets_s is not None:
            first_s, last_s = float(sweep.offsets_s.min()), float(sweep.offsets_s.max())
        self._found.clouds.append(
            SeenCloud(
                topic,
                number,
                frame=sweep.frame,
                stamp_ns=stamp_ns,
                first_ns=stamp_ns + round(first_s * 1e9),
                last_ns=stamp_ns + round(last_s * 1e9),
            )
        )

    def _take_tf(self, message: Message, decoded: Any) -> None:
        static = message.connection.topic.endswith("tf_static")
        for transform in transforms_of_tf(decoded, static=static):
            try:
                self._found.frames.add(self._timed(transform, message))
            except InvalidInputError as error:
                self._found.broken.setdefault(message.connection.topic, []).append(str(error))

    def _take_pose(self, message: Message, decoded: Any) -> None:
        topic, kind = message.connection.topic, message.connection.msgtype
        if kind == type_store.ODOMETRY:
            transform = transform_of_odometry(decoded)
        else:
            transform = transform_of_pose(decoded, "")
        transform = self._timed(transform, message)
        try:
            position, quaternion = transform.pose.numbers()
        except InvalidInputError as error:
            self._found.broken.setdefault(topic, []).append(str(error))
            return
        assert transform.stamp_ns is not STATIC
        known = self._found.poses.setdefault(topic, PoseTopic(kind))
        known.parent, known.child = transform.parent, transform.child
        known.track.add(transform.stamp_ns, position, quaternion)

    def _timed(self, transform: Transform, message: Message) -> Transform:
        if not self._recorder_clock or transform.stamp_ns is STATIC:
            return transform
        return Transform(transform.parent, transform.child, message.recorded_ns, transform.pose)
