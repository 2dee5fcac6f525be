"""Recordings of ROS: clouds and depth images, placed by the recorded poses that place the most."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from triquad_tools.console.command import ToolError
from triquad_tools.recordings import pose_source
from triquad_tools.recordings.arguments import SENSOR, WORLD
from triquad_tools.recordings.bag import Bag, Message
from triquad_tools.recordings.folders.trajectory import read_trajectory
from triquad_tools.recordings.odometry import find_trajectory
from triquad_tools.recordings.pose_source import PoseSource, check_places, check_times
from triquad_tools.recordings.recording import ReadingOptions, ScanEntry, Stream, with_remedies
from triquad_tools.recordings.ros_content import RosContent, SeenCloud
from triquad_tools.sensors.motion.frame_graph import ROOT_NAMES
from triquad_tools.sensors.motion.placing import place
from triquad_tools.sensors.ros import type_store
from triquad_tools.sensors.ros.depth_camera import raw_topic
from triquad_tools.sensors.ros.message_reader import MessageReader
from triquad_tools.sensors.ros.type_store import ALL_TF, TRANSFORMS, source_of_topic
from triquad_tools.sensors.sweep import NoScanError, PosedScan, Sweep

_CLOCKS = (
    "no cloud's stamp lies within the times of the poses: where they are of another clock, "
    "--recorder-clock goes by when each message was recorded"
)
_NO_TRANSFORM = (
    "record /tf and /tf_static, or say where the sensor sits with --transform '{body} {root} X Y Z "
    "QX QY QZ QW' (0 0 0 0 0 0 1 where the poses are its own)"
)
_ASSUMED = (
    "{topic}: taken as poses of {body}, since its messages do not say whose they are; if they are "
    "of another frame, name it with --body-frame, and say where the sensor sits with --transform"
)
_MISSING = (
    "{count:,} messages that its index names could not be read: it is damaged; 'mcap recover', "
    "'rosbag reindex' or 'ros2 bag reindex' saves what is left"
)
_STANDS = (
    "its points are in {frame}, which stands still in the map while {body} moves, so their rays do "
    "not begin there: map the topic of clouds in the frame of the sensor. Where there is none, "
    "--points-in world has them begin at {body}, or at the frame of --body-frame, and --ray-origin "
    "X,Y,Z where the sensor sits on it; --points-in sensor is for a sensor that does stand there"
)
_NO_CLOUDS = (
    "it holds no clouds (PointCloud2, Livox CustomMsg) and no depth images (Image of 16UC1, mono16 "
    "or 32FC1): nothing to map"
)
_PACKETS = {
    package: f"packets: play it to {driver}, and record the PointCloud2 that this publishes"
    for driver, packages in {
        "velodyne_pointcloud": ("velodyne_msgs",),
        "os_cloud of ouster_ros": ("ouster_ros", "ouster_msgs", "ouster_sensor_msgs"),
        "the driver of Hesai": ("hesai_ros_driver", "pandar_msgs", "hesai_lidar"),
        "rslidar_sdk": ("rslidar_msg", "rslidar_msgs"),
        "laser_geometry": ("sensor_msgs",),
    }.items()
    for package in packages
}
"""What makes clouds of packets, and of scans of one plane, by the packages of their types."""
_OF_TIME = ("pose_early", "pose_late")


class RosRecording:
    """A bag or an MCAP file with clouds or depth images, and poses."""

    def __init__(self, bag: Bag, options: ReadingOptions) -> None:
        """Check all of it."""
        self._bag = bag
        self._reader = MessageReader(
            units_per_metre=options.units_per_metre,
            stride=options.stride,
            deskew=options.deskew,
            by_arrival=options.recorder_clock,
        )
        self._content = RosContent(bag, self._reader, options.poses)
        self._topics = _chosen_topics(self._content, options)
        self._options = options
        clouds = [cloud for cloud in self._content.clouds if cloud.topic in self._topics]
        good = [cloud for cloud in clouds if cloud.problem is None]
        check_times(good)
        self._poses = self._choose_poses(good)
        self._placed: list[SeenCloud] = []
        self._left_out: dict[tuple[str, str], list[SeenCloud]] = defaultdict(list)
        self._place(clouds)
        if options.map_frame is None:
            check_places(self._placed, self._poses)

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
        poses = self._poses
        lines += poses.remarks
        lines += [_ASSUMED.format(topic=poses.name, body=poses.body)] if poses.assumed else []
        sensors = dict.fromkeys(cloud.frame for cloud in self._placed)
        corrected = (poses.frames.corrections(poses.target, frame) for frame in sensors)
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
            topic = message.channel.topic
            key = topic, numbers[topic]
            numbers[topic] += 1
            if key in wanted:
                wanted.discard(key)
                yield self._read(message)
                if not wanted:
                    return
        if wanted:
            raise ToolError(
                f"{self._bag.path}: {len(wanted)} scans are no longer there; has it changed since "
                "it was looked through?"
            )

    def _choose_poses(self, clouds: Sequence[SeenCloud]) -> PoseSource:
        options = self._options
        if not clouds or not (options.odometry or options.trajectory):
            return pose_source.choose_poses(self._content, clouds, options)
        if options.trajectory is not None:
            found = read_trajectory(options.trajectory, options.quaternion)
        else:
            found = find_trajectory(self._sweeps(clouds), len(clouds), close_loops=options.loops)
        return pose_source.poses_of_trajectory(self._content, clouds, found, options)

    def _sweeps(self, clouds: Sequence[SeenCloud]) -> Iterator[Sweep]:
        """Yield the sweeps of clouds, which have to be those of one lidar."""
        topics = sorted({cloud.topic for cloud in clouds})
        if len(topics) > 1 or self._content.kinds[topics[0]] in type_store.IMAGES:
            raise ToolError(
                f"--odometry takes the clouds of one lidar, and there is {', '.join(topics)}: "
                "choose a topic of clouds with --topics"
            )
        wanted = {cloud.number for cloud in clouds}
        messages = self._bag.messages(lambda channel: channel.topic == topics[0])
        for number, message in enumerate(messages):
            if number in wanted:
                about = message.channel.kind, message.decoded(), message.recorded_ns
                yield self._reader.sweep(topics[0], *about)

    def _read(self, message: Message) -> PosedScan:
        topic, kind = message.channel.topic, message.channel.kind
        try:
            sweep = self._reader.sweep(topic, kind, message.decoded(), message.recorded_ns)
            scan = place(sweep, self._poses.frames, self._poses.target)
            return self._poses.seen(scan, sweep) if self._stands(sweep.frame) else scan
        except NoScanError as error:
            raise ToolError(f"{self._bag.path}: a message on {topic}: {error}") from error

    def _stands(self, frame: str) -> bool:
        """Return whether points in a frame are taken to stand still in the map, as it does."""
        return self._options.points_in == WORLD and not self._poses.moves(frame)

    def _place(self, clouds: Sequence[SeenCloud]) -> None:
        """Find out which clouds the poses place."""
        if self._options.points_in == WORLD:
            self._poses.know({cloud.frame for cloud in clouds if cloud.problem is None})
        newest_ns: dict[str, int] = {}
        for cloud in clouds:
            problem = self._problem(cloud, newest_ns)
            if problem is None:
                newest_ns[cloud.topic] = cloud.stamp_ns
                self._placed.append(cloud)
            else:
                self._leave_out(cloud, problem)
        for topic, frame in dict.fromkeys((each.topic, each.frame) for each in self._placed):
            self._check_rays(topic, frame)

    def _leave_out(self, cloud: SeenCloud, problem: NoScanError) -> None:
        self._left_out[cloud.topic, problem.reason].append(replace(cloud, problem=problem))

    def _check_rays(self, topic: str, frame: str) -> None:
        """Leave out placed clouds whose points and poses cannot be metres seen from their frame."""
        if self._stands(frame) or self._options.ray_origin is not None:
            return
        clouds = [each for each in self._placed if (each.topic, each.frame) == (topic, frame)]
        stamps = np.array([cloud.stamp_ns for cloud in clouds])
        poses = self._poses.frames.poses(self._poses.target, frame, stamps)
        problem = with_remedies(self._content.rays.problem(topic, poses[:, :3, 3]))
        if problem is not None:
            self._placed = [
                each for each in self._placed if (each.topic, each.frame) != (topic, frame)
            ]
            for cloud in clouds:
                self._leave_out(cloud, problem)

    def _problem(self, cloud: SeenCloud, newest_ns: dict[str, int]) -> NoScanError | None:
        if cloud.problem is not None:
            return cloud.problem
        if cloud.stamp_ns < newest_ns.get(cloud.topic, cloud.stamp_ns):
            return NoScanError("time_backwards", "its stamp lies before that of the one before it")
        return self._poses.find(cloud) or self._misplaced(cloud)

    def _misplaced(self, cloud: SeenCloud) -> NoScanError | None:
        """Return why the rays of a cloud, whose pose is known, do not begin at its frame."""
        body = self._poses.body
        if self._stands(cloud.frame):
            return self._poses.find(replace(cloud, frame=body))
        if self._options.points_in == SENSOR or self._poses.moves(cloud.frame):
            return None
        return NoScanError("map_frame", _STANDS.format(frame=cloud.frame, body=body))

    def _left_out_line(self, topic: str, reason: str) -> str:
        clouds = self._left_out[topic, reason]
        of_topic = sum(cloud.topic == topic for cloud in self._content.clouds)
        line = f"{topic}: {len(clouds)} of {of_topic} are left out: {clouds[0].problem}"
        if reason == "no_transform" and clouds[0].frame in ROOT_NAMES:
            return f"{line}; if its points are in the map already, use --points-in world"
        if reason == "no_transform":
            root = self._content.frames.root(clouds[0].frame)
            return f"{line}; {_NO_TRANSFORM.format(body=self._poses.body, root=root)}"
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
        use, count = self._use(topic), found.counts[topic]
        first_ns, last_ns = found.spans_ns.get(topic, (0, 0))
        if last_ns > first_ns:
            use += f", {(count - 1) / (last_ns - first_ns) * 1e9:.1f} Hz"
        return Stream(topic, found.kinds[topic], count, use, frame)

    def _use(self, topic: str) -> str:
        placed = sum(each.topic == topic for each in self._placed)
        if placed:
            notes = Counter(each.note for each in self._placed if each.topic == topic)
            words = [note for note, _ in notes.most_common(2) if note]
            return ", ".join([f"{placed} scans", f"source {source_of_topic(topic)}", *words])
        chosen, kind = self._poses.name, self._content.kinds[topic]
        if kind in TRANSFORMS:
            return "the poses" if chosen == ALL_TF else "where sensors sit"
        if kind in type_store.POSES:
            return "the poses" if chosen == topic else f"other poses: --poses {topic}"
        if kind == type_store.CAMERA_INFO:
            return "a camera"
        if topic in self._content.foreign:
            return f"not read: {self._content.foreign[topic]}, not a message of ROS"
        if not any(cloud.topic == topic for cloud in self._content.clouds):
            is_raw = "Pack" in kind or "Scan" in kind
            return _PACKETS.get(kind.partition("/")[0], "not used") if is_raw else "not used"
        return (
            "none is placed, as told below"
            if topic in self._topics
            else f"other scans: --topics {topic}"
        )


def _chosen_topics(found: RosContent, options: ReadingOptions) -> set[str]:
    """Return the topics to map: those asked for, else all clouds, or if none, all depth images."""
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
