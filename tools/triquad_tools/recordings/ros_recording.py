"""Recordings of ROS: clouds and depth images, placed by the poses that were recorded with them."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from triquad_tools.console.command import ToolError
from triquad_tools.recordings.bag import Bag, Message
from triquad_tools.recordings.pose_source import TF, PoseSource, choose_poses
from triquad_tools.recordings.recording import ScanEntry, Stream
from triquad_tools.recordings.ros_options import RosOptions
from triquad_tools.recordings.ros_survey import SeenCloud, Survey, survey, sweep_of_image
from triquad_tools.sensors.errors import NoScanError
from triquad_tools.sensors.motion.frame_tree import ROOT_NAMES
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.ros import type_store
from triquad_tools.sensors.ros.point_cloud import sweep_of_cloud
from triquad_tools.sensors.ros.topic import source_of_topic
from triquad_tools.sensors.sweep import PosedScan, Sweep

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
class _PlacedCloud:
    """A cloud that can be mapped, and where in the recording it is."""

    entry: ScanEntry
    topic: str
    number: int  # of the messages on its topic


class RosRecording:
    """A bag or an MCAP file with clouds or depth images, and poses."""

    def __init__(self, bag: Bag, options: RosOptions) -> None:
        """Check all of it.

        Raises:
            ToolError: it is damaged, or does not hold what ``options`` ask for.
        """
        self._bag = bag
        self._options = options
        self._survey = survey(bag, recorder_clock=options.recorder_clock)
        self._topics = _chosen_topics(self._survey, options)
        self._poses: PoseSource | None = None
        self._left_out: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
        self._placed = self._place_clouds()

    @property
    def entries(self) -> Sequence[ScanEntry]:
        """The scans that can be mapped, in the order of their recording."""
        return [placed.entry for placed in self._placed]

    @property
    def streams(self) -> Sequence[Stream]:
        """The topics."""
        return [self._stream(topic) for topic in sorted(self._survey.kinds)]

    @property
    def remarks(self) -> Sequence[str]:
        """The problems: what is left out and why, and what to do about it, a line each."""
        lines: list[str] = []
        if self._survey.missing > 0:
            lines.append(_MISSING.format(count=self._survey.missing))
        if not self._survey.clouds:
            return [
                *lines,
                "it holds no clouds (PointCloud2) and no depth images (Image): nothing to map",
            ]
        lines += [
            f"{topic}: {len(texts)} poses are left out: {texts[0]}"
            for topic, texts in self._survey.broken.items()
        ]
        if self._poses is not None and self._poses.assumed:
            lines.append(_ASSUMED.format(topic=self._poses.name, body=self._poses.body))
        for topic, by_reason in self._left_out.items():
            lines += [
                self._left_out_line(topic, reason, texts) for reason, texts in by_reason.items()
            ]
        return lines

    def read(self, indices: Sequence[int]) -> Iterator[PosedScan]:
        """Yield the scans of these numbers, which increase, one after the other.

        Raises:
            ToolError: the recording is no longer what it was when it was checked.
        """
        wanted = {(self._placed[i].topic, self._placed[i].number) for i in indices}
        if not wanted:
            return
        topics = {topic for topic, _ in wanted}
        numbers: dict[str, int] = defaultdict(int)
        with self._bag.open() as opened:
            connections = [c for c in opened.connections if c.topic in topics]
            for message in opened.messages(connections):
                topic = message.connection.topic
                key = topic, numbers[topic]
                numbers[topic] += 1
                if key in wanted:
                    wanted.discard(key)
                    yield self._read(message, opened.decode(message))
        if wanted:
            raise ToolError(
                f"{self._bag.path}: {len(wanted)} scans are no longer there; has it changed since "
                "it was looked through?"
            )

    def _read(self, message: Message, decoded: Any) -> PosedScan:
        assert self._poses is not None
        try:
            sweep = self._sweep(message, decoded)
            return place(sweep, self._poses.frames, self._poses.target)
        except NoScanError as error:
            topic = message.connection.topic
            raise ToolError(f"{self._bag.path}: a message on {topic}: {error}") from error

    def _sweep(self, message: Message, decoded: Any) -> Sweep:
        topic, kind = message.connection.topic, message.connection.msgtype
        if kind == type_store.POINT_CLOUD:
            sweep = sweep_of_cloud(decoded)
        else:
            stride = self._options.depth_stride
            sweep = sweep_of_image(decoded, topic, self._survey.cameras, stride=stride)
        if self._options.recorder_clock:
            sweep = replace(sweep, stamp_ns=message.recorded_ns)
        return sweep

    def _place_clouds(self) -> list[_PlacedCloud]:
        """Choose the poses, and find out which clouds they place."""
        clouds = [cloud for cloud in self._survey.clouds if cloud.topic in self._topics]
        good = [cloud for cloud in clouds if cloud.problem is None]
        if good:
            self._poses = choose_poses(self._survey, good, self._options)
        newest: dict[str, int] = {}
        placed: list[_PlacedCloud] = []
        for cloud in clouds:
            problem = self._problem(cloud, newest)
            if problem is not None:
                self._left_out[cloud.topic][problem.reason].append(str(problem))
                continue
            newest[cloud.topic] = cloud.stamp_ns
            entry = ScanEntry(cloud.stamp_ns, source_of_topic(cloud.topic))
            placed.append(_PlacedCloud(entry, cloud.topic, cloud.number))
        return placed

    def _problem(self, cloud: SeenCloud, newest: dict[str, int]) -> NoScanError | None:
        if cloud.problem is not None:
            return cloud.problem
        if self._poses is None:
            return NoScanError("no_poses", _NO_POSES)
        if cloud.stamp_ns < newest.get(cloud.topic, cloud.stamp_ns):
            return NoScanError("time_backwards", "its stamp lies before that of the one before it")
        return self._poses.find(cloud)

    def _left_out_line(self, topic: str, reason: str, texts: list[str]) -> str:
        of_topic = sum(cloud.topic == topic for cloud in self._survey.clouds)
        line = f"{topic}: {len(texts)} of {of_topic} are left out: {texts[0]}"
        if reason == "no_transform":
            frame = next(cloud.frame for cloud in self._survey.clouds if cloud.topic == topic)
            return f"{line}; {_NO_TRANSFORM.format(frame=frame)}"
        if reason in _OF_TIME and not any(placed.topic == topic for placed in self._placed):
            return f"{line}; {_CLOCKS}"
        return line

    def _stream(self, topic: str) -> Stream:
        found = self._survey
        of_topic = [cloud for cloud in found.clouds if cloud.topic == topic]
        frames = sorted({cloud.frame for cloud in of_topic if cloud.frame})
        poses = found.poses.get(topic)
        if poses is not None:
            frames = [f"{poses.parent} > {poses.child or '?'}"]
        return Stream(
            topic,
            found.kinds[topic],
            found.counts[topic],
            frame=", ".join(frames),
            use=self._use(topic, bool(of_topic)),
        )

    def _use(self, topic: str, has_clouds: bool) -> str:
        """Return what a topic is used for."""
        placed = sum(each.topic == topic for each in self._placed)
        if placed:
            return f"{placed} scans, source {source_of_topic(topic)}"
        source = self._poses.name if self._poses else ""
        if source == topic:
            return "the poses"
        match self._survey.kinds[topic]:
            case type_store.TF | type_store.TF_OF_ROS_1:
                return "the poses" if source == TF else "where sensors sit"
            case type_store.ODOMETRY | type_store.POSE:
                return f"other poses: --poses {topic}"
            case type_store.CAMERA_INFO:
                return "a camera"
        if has_clouds and topic not in self._topics:
            return f"other scans: --topics {topic}"
        return "none can be placed" if has_clouds else "not used"


def _chosen_topics(found: Survey, options: RosOptions) -> set[str]:
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
    clouds = {topic for topic in scans if found.kinds[topic] == type_store.POINT_CLOUD}
    return clouds or scans
