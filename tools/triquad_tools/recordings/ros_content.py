"""What a recording of ROS holds, found in one pass over it."""

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from triquad_format.errors import InvalidInputError

from triquad_tools.console.progress import progress
from triquad_tools.recordings.bag import Bag, Channel, Message
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.track import STATIC, Track, Transform
from triquad_tools.sensors.ray_check import RayCheck
from triquad_tools.sensors.ros import type_store
from triquad_tools.sensors.ros.depth_camera import holds_depth
from triquad_tools.sensors.ros.message_reader import MessageReader
from triquad_tools.sensors.ros.type_store import PATH, POSES, TRANSFORMS
from triquad_tools.sensors.sweep import NoScanError

_SCANS = (*type_store.CLOUDS, *type_store.IMAGES)
_USED = (*TRANSFORMS, *POSES, *_SCANS)
_REPORTED = 500  # messages, after which the progress is shown again


@dataclass(frozen=True)
class SeenCloud:
    """A cloud or depth image whose points were checked, but not kept."""

    topic: str
    number: int  # of the messages on its topic
    frame: str = ""
    stamp_ns: int = 0
    first_ns: int = 0  # when its first point was measured
    last_ns: int = 0
    note: str = ""  # how it was read, for a user
    file: Path = Path()  # which has it
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

    def __init__(self, bag: Bag, reader: MessageReader, poses: str | None = None) -> None:
        """Read all of a bag; where ``poses`` is a topic of transforms, no others that move."""
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
        self.spans_ns: dict[str, list[int]] = {}  # when the first and last of a topic was recorded
        self.foreign: dict[str, str] = {}  # encodings of topics that are not of ROS
        channels = bag.channels()
        transforms = [each.topic for each in channels if each.kind in TRANSFORMS]
        self._only = poses if poses in transforms else ""
        for channel in channels:
            self.kinds[channel.topic] = channel.kind
            self.counts[channel.topic] += channel.count
            if channel.foreign:
                self.foreign[channel.topic] = channel.foreign
        # Cameras first: an image may come before what is known of its camera.
        cameras = {each.topic for each in channels if _is_camera(each) and each.count}
        for message in bag.messages(_is_camera) if cameras else ():
            self._take(message)
            cameras.discard(message.channel.topic)
            if not cameras:
                break
        self._read(bag, sum(each.count for each in channels if _is_read(each)))

    def _read(self, bag: Bag, total: int) -> None:
        done, paths = 0, dict[str, Message]()
        with progress("looking through the recording", total) as report:
            for done, message in enumerate(bag.messages(_is_read), start=1):
                topic = message.channel.topic
                self.spans_ns.setdefault(topic, [message.recorded_ns] * 2)[1] = message.recorded_ns
                if message.channel.kind == PATH:
                    paths[topic] = message  # the newest one has all poses
                elif topic not in self._colours:
                    self._take(message)
                if done % _REPORTED == 0:
                    report(done, f"{done} of {total} messages")
            report(done, f"{done} of {total} messages")
        for path in paths.values():
            self._take(path)
        self.missing = total - done

    def _take(self, message: Message) -> None:
        topic, kind = message.channel.topic, message.channel.kind
        try:
            decoded = message.decoded()
            if kind == type_store.CAMERA_INFO:
                self._reader.cameras[topic] = decoded
            elif kind in (*TRANSFORMS, *POSES):
                static, came_ns = topic.endswith("tf_static"), message.recorded_ns
                if kind in TRANSFORMS and not static and self._only not in ("", topic):
                    return
                found = self._reader.transforms(kind, decoded, came_ns, static=static)
                for each in found:
                    self._add(topic, each, is_pose=kind in POSES)
                if kind == PATH and len(self.poses[topic].track) < len(found):
                    self.broken[topic].append("they have no times of their own")
            elif kind in type_store.IMAGES and not holds_depth(decoded):
                self._colours.add(topic)
            else:
                self._add_cloud(message, decoded)
        except NoScanError as error:
            self._leave_out(message, error)
        except AttributeError as error:  # a bag brings its own definitions of types
            text = f"not as {kind} is defined: {error}"
            self._leave_out(message, NoScanError("decode", text))

    def _leave_out(self, message: Message, problem: NoScanError) -> None:
        topic = message.channel.topic
        if message.channel.kind in _SCANS:
            self.clouds.append(SeenCloud(topic, self._numbers[topic], problem=problem))
            self._numbers[topic] += 1
        else:
            self.broken[topic].append(str(problem))

    def _add_cloud(self, message: Message, decoded: Any) -> None:
        topic = message.channel.topic
        sweep = self._reader.sweep(topic, message.channel.kind, decoded, message.recorded_ns)
        number, (first_ns, last_ns) = self._numbers[topic], sweep.span_ns
        self._numbers[topic] += 1
        self.rays.see(topic, sweep.points, is_depth=message.channel.kind in type_store.IMAGES)
        about = sweep.frame, sweep.stamp_ns, first_ns, last_ns, sweep.note, message.channel.file
        self.clouds.append(SeenCloud(topic, number, *about))

    def _add(self, topic: str, transform: Transform, *, is_pose: bool) -> None:
        try:
            if not is_pose:
                self.frames.add(transform)
                return
            position, quaternion = transform.numbers()
        except InvalidInputError as error:
            self.broken[topic].append(str(error))
            return
        known = self.poses[topic]
        known.parent, known.child = transform.parent, transform.child
        assert transform.stamp_ns is not STATIC
        known.track.add(transform.stamp_ns, position, quaternion)


def _is_camera(channel: Channel) -> bool:
    return channel.kind == type_store.CAMERA_INFO and not channel.foreign


def _is_read(channel: Channel) -> bool:
    return channel.kind in _USED and not channel.foreign
