"""Recordings of ROS: clouds and depth images, placed by the recorded poses that place the most."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.bag import Bag, Message
from triquad_tools.recordings.recording import ReadingOptions, ScanEntry, Stream
from triquad_tools.recordings.ros_content import RosContent, SeenCloud
from triquad_tools.sensors.motion.frame_tree import ROOT_NAMES, FrameTree
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.ros import type_store
from triquad_tools.sensors.ros.depth_camera import raw_topic
from triquad_tools.sensors.ros.header import source_of_topic
from triquad_tools.sensors.ros.message_reader import MessageReader
from triquad_tools.sensors.ros.type_store import TRANSFORMS
from triquad_tools.sensors.sweep import NoScanError, NoTransformError, PosedScan

TF = "tf"
"""Stands for all transforms, whatever their topics."""

_CLOCKS = (
    "no cloud's stamp lies within the times of the poses: where they are of another clock, "
    "--recorder-clock goes by when each message was recorded"
)
_NO_TRANSFORM = (
    "record /tf and /tf_static, or say where the sensor sits with --transform, or that the poses "
    "are its own with --body-frame {frame}"
)
_ASSUMED = (
    "{topic}: taken as poses of {body}, since its messages do not say whose they are; if they are "
    "of another frame, name it with --body-frame, and say where the sensor sits with --transform"
)
_MISSING = (
    "{count:,} messages that its index names could not be read: it is damaged; 'mcap recover', "
    "'rosbag reindex' or 'ros2 bag reindex' saves what is left"
)
_NO_CLOUDS = "it holds no clouds (PointCloud2) and no depth images (Image): nothing to map"
_NO_POSES = (
    "it holds no poses: record /tf with /tf_static, or a topic of odometry or poses, together with "
    "the clouds"
)
_OF_TIME = ("pose_early", "pose_late")


@dataclass(frozen=True)
class PoseSource:
    """Poses that may be used, and the frame to map in."""

    name: str  # a topic, or TF
    frames: FrameTree
    target: str
    body: str  # the frame whose poses they are, or one that hangs on it
    assumed: bool = False  # nothing says that they are its poses

    def find(self, cloud: SeenCloud) -> NoTransformError | None:
        """Return why the pose of a cloud is not known; None if it is."""
        times = np.array([cloud.first_ns, cloud.last_ns], np.int64)
        try:
            self.frames.poses(self.target, cloud.frame, times)
        except NoTransformError as error:
            return error
        return None


def choose_poses(
    content: RosContent, clouds: Sequence[SeenCloud], options: ReadingOptions
) -> PoseSource | None:
    """Return the source that places the most clouds; None if there is no pose at all.

    Raises:
        ToolError: the source that was asked for does not exist.
    """
    for transform in options.transforms:
        content.frames.add(transform)
    content.frames.wanted = options.map_frame or ""
    frame = clouds[0].frame
    names = [TF, *content.poses]
    if options.poses is not None and content.kinds.get(options.poses) not in TRANSFORMS:
        if options.poses not in names:
            raise ToolError(
                f"--poses {options.poses}: there are no such poses, only {', '.join(names)}"
            )
        names = [options.poses]
    sources = [
        _of_tf(content.frames, frame, options)
        if name == TF
        else _of_topic(content, name, frame, options)
        for name in names
    ]
    for source in sources:
        source.frames.check()
    # Transforms that always hold are no poses.
    moving = [source for source in sources if source.frames.moves(source.target, source.body)]

    def merit(source: PoseSource) -> tuple[int, bool]:
        placed = sum(source.find(cloud) is None for cloud in clouds)
        return placed, source.target in ROOT_NAMES

    return max(moving, key=merit, default=None)


def _of_tf(frames: FrameTree, frame: str, options: ReadingOptions) -> PoseSource:
    """Return all transforms. If they do not reach the sensor, finding a cloud says so."""
    body = frame
    if not frames.moves(frames.root(frame), frame):
        body = next(iter(frames.moving), frame)
    return PoseSource(TF, frames, options.map_frame or frames.fixed_frame(body), body)


def _of_topic(content: RosContent, topic: str, frame: str, options: ReadingOptions) -> PoseSource:
    """Return the poses of a topic, in the tree of all transforms but those that say the same."""
    poses = content.poses[topic]
    # Where a topic does not name the body, it is what the sensor is fixed to.
    body = options.body_frame or poses.child or content.frames.root(frame)
    frames = content.frames.with_track(poses.parent, body, poses.track)
    target = options.map_frame or frames.fixed_frame(body)
    assumed = not (options.body_frame or poses.child)
    return PoseSource(topic, frames, target, body, assumed=assumed)


class RosRecording:
    """A bag or an MCAP file with clouds or depth images, and poses."""

    def __init__(self, bag: Bag, options: ReadingOptions) -> None:
        """Check all of it.

        Raises:
            ToolError: it is damaged, or does not hold what ``options`` ask for.
        """
        self._bag = bag
        self._reader = MessageReader(stride=options.stride, by_arrival=options.recorder_clock)
        self._content = RosContent(bag, self._reader, options.poses)
        self._topics = _chosen_topics(self._content, options)
        self._poses: PoseSource | None = None
        self._placed: list[SeenCloud] = []
        self._left_out: dict[tuple[str, str], list[SeenCloud]] = defaultdict(list)
        self._place_clouds(options)

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The scans that can be mapped, in the order of their recording."""
        return [ScanEntry(one.stamp_ns, source_of_topic(one.topic)) for one in self._placed]

    @property
    def streams(self) -> Sequence[Stream]:
        """The topics."""
        return [self._stream(topic) for topic in sorted(self._content.kinds)]

    @property
    def remarks(self) -> Sequence[str]:
        """The problems: what is left out and why, and what to do about it, a line each."""
        found = self._content
        lines = [*self._bag.remarks]
        lines += [_MISSING.format(count=found.missing)] if found.missing > 0 else []
        if found.foreign:
            others = ", ".join(f"{topic} ({what})" for topic, what in found.foreign.items())
            lines.append(f"left out, since they are not encoded as messages of ROS: {others}")
        if not found.clouds:
            return [*lines, _NO_CLOUDS]
        lines += [
            f"{topic}: {len(texts)} poses are left out: {texts[0]}"
            for topic, texts in found.broken.items()
        ]
        if self._poses is not None and self._poses.assumed:
            lines.append(_ASSUMED.format(topic=self._poses.name, body=self._poses.body))
        if self._poses is not None:
            frames, target = self._poses.frames, self._poses.target
            sensors = dict.fromkeys(cloud.frame for cloud in self._placed)
            corrected = (frames.corrections(target, frame) for frame in sensors)
            lines += dict.fromkeys(line for each in corrected for line in each)
        return [*lines, *(self._left_out_line(*key) for key in self._left_out)]

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers, which increase, one after the other.

        Raises:
            ToolError: the recording is no longer what it was when it was checked.
        """
        wanted = {(self._placed[i].topic, self._placed[i].number) for i in indices}
        topics = {topic for topic, _ in wanted}
        numbers: Counter[str] = Counter()
        for message in self._bag.messages(lambda channel: channel.topic in topics):
            key = message.topic, numbers[message.topic]
            numbers[message.topic] += 1
            if key in wanted:
                wanted.discard(key)
                yield self._read(message)
        if wanted:
            raise ToolError(
                f"{self._bag.path}: {len(wanted)} scans are no longer there; has it changed since "
                "it was looked through?"
            )

    def _read(self, message: Message) -> PosedScan:
        assert self._poses is not None
        decoded, came_ns = message.decoded(), message.recorded_ns
        try:
            sweep = self._reader.sweep(message.topic, message.kind, decoded, came_ns)
            return place(sweep, self._poses.frames, self._poses.target)
        except NoScanError as error:
            raise ToolError(f"{self._bag.path}: a message on {message.topic}: {error}") from error

    def _place_clouds(self, options: ReadingOptions) -> None:
        """Choose the poses, and find out which clouds they place."""
        clouds = [cloud for cloud in self._content.clouds if cloud.topic in self._topics]
        good = [cloud for cloud in clouds if cloud.problem is None]
        if good:
            self._poses = choose_poses(self._content, good, options)
        newest_ns: dict[str, int] = {}
        for cloud in clouds:
            problem = self._problem(cloud, newest_ns)
            if problem is None:
                newest_ns[cloud.topic] = cloud.stamp_ns
                self._placed.append(cloud)
            else:
                left_out = replace(cloud, problem=problem)
                self._left_out[cloud.topic, problem.reason].append(left_out)

    def _problem(self, cloud: SeenCloud, newest_ns: dict[str, int]) -> NoScanError | None:
        if cloud.problem is not None:
            return cloud.problem
        if self._poses is None:
            return NoScanError("no_poses", _NO_POSES)
        if cloud.stamp_ns < newest_ns.get(cloud.topic, cloud.stamp_ns):
            return NoScanError("time_backwards", "its stamp lies before that of the one before it")
        return self._poses.find(cloud)

    def _left_out_line(self, topic: str, reason: str) -> str:
        clouds = self._left_out[topic, reason]
        of_topic = sum(cloud.topic == topic for cloud in self._content.clouds)
        line = f"{topic}: {len(clouds)} of {of_topic} are left out: {clouds[0].problem}"
        if reason == "no_transform":
            return f"{line}; {_NO_TRANSFORM.format(frame=clouds[0].frame)}"
        if reason in _OF_TIME and not any(placed.topic == topic for placed in self._placed):
            return f"{line}; {_CLOCKS}"
        return line

    def _stream(self, topic: str) -> Stream:
        found = self._content
        frames = {cloud.frame for cloud in found.clouds if cloud.topic == topic and cloud.frame}
        if topic in found.poses:
            poses = found.poses[topic]
            frames = {f"{poses.parent} > {poses.child or '?'}"}
        frame = ", ".join(sorted(frames))
        return Stream(topic, found.kinds[topic], found.counts[topic], self._use(topic), frame)

    def _use(self, topic: str) -> str:
        """Return what a topic is used for."""
        placed = sum(each.topic == topic for each in self._placed)
        if placed:
            notes = dict.fromkeys(each.note for each in self._placed if each.topic == topic)
            words = f"{placed} scans", f"source {source_of_topic(topic)}", *notes
            return ", ".join(filter(None, words))
        chosen = self._poses.name if self._poses else ""
        kind = self._content.kinds[topic]
        if kind in TRANSFORMS:
            return "the poses" if chosen == TF else "where sensors sit"
        if kind in type_store.POSES:
            return "the poses" if chosen == topic else f"other poses: --poses {topic}"
        if kind == type_store.CAMERA_INFO:
            return "a camera"
        if topic in self._content.foreign:
            return f"not read: {self._content.foreign[topic]}, not a message of ROS"
        if not any(cloud.topic == topic for cloud in self._content.clouds):
            return "not used"
        return "none can be placed" if topic in self._topics else f"other scans: --topics {topic}"


def _chosen_topics(found: RosContent, options: ReadingOptions) -> set[str]:
    """Return the topics to map: those asked for, else all clouds, or if none, all depth images.

    Raises:
        ToolError: a topic that was asked for has nothing to map.
    """
    there = {cloud.topic for cloud in found.clouds}
    for topic in options.topics:
        if topic not in there:
            kind = found.kinds.get(topic)
            what = f"is {kind}, no clouds or depth images" if kind else "does not exist"
            known = ", ".join(sorted(there)) or "none"
            raise ToolError(f"--topics {topic}: the topic {what}; to map there is {known}")
    if options.topics:
        return set(options.topics)
    # A cloud in a frame that stands still is no scan, but a map made of scans.
    scans = {cloud.topic for cloud in found.clouds if cloud.frame not in ROOT_NAMES} or there
    clouds = {topic for topic in scans if found.kinds[topic] not in type_store.IMAGES}
    # Of an image that was recorded twice, as it is and compressed, the first is enough.
    return clouds or {each for each in scans if raw_topic(each) not in scans - {each}}
