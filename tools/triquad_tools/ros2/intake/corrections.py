"""Corrections of poses, where a loop is closed: a path changes, or odometry's frame jumps."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import zenoh
from triquad_client import Client
from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.pose import pose_matrices
from triquad_format.wire.limits import MAX_KEYFRAMES

from triquad_tools.ros2.intake.drop_log import DropLog
from triquad_tools.ros2.intake.frame_jumps import FrameJumps
from triquad_tools.ros2.intake.placement import Placed
from triquad_tools.ros2.intake.source_poses import Poses, SourcePoses
from triquad_tools.sensors.motion.frame_tree import FrameTree
from triquad_tools.sensors.motion.track import Transform
from triquad_tools.sensors.ros.from_bytes import decode_cdr
from triquad_tools.sensors.ros.message_reader import MessageReader
from triquad_tools.sensors.ros.type_store import ALL_TF, PATH, source_of_topic
from triquad_tools.sensors.sweep import NoScanError, PosedScan

_log = logging.getLogger("triquad_ros2")

_PERIOD_S = 1.0  # between two paths that are read: some are published ten times a second
_RETRY_S = 30.0  # after an error
_REFUSED = "not_corrected"
_LEAVE_S = 1.0  # for a correction to end, once the bridge does; the server goes on with it


class BodyPath(NamedTuple):
    """Where the robot's body was, as is known by now."""

    parent: str  # the frame that the poses are in
    stamps_ns: Longs  # [K] rising
    parent_from_body: Doubles  # [K, 4, 4]


class _Arrived(NamedTuple):
    """A path as it arrived, and the newest scan of each source before it."""

    topic_name: str
    read: Callable[[], BodyPath | None]
    until_ns: dict[str, int]


class Corrections:
    """Has the server correct the poses of scans where the newest path has others."""

    def __init__(self, client: Client, drops: DropLog, frames: FrameTree, wait_s: float) -> None:
        """``frames`` tell where the robot's body was, whose poses paths have.

        ``wait_s`` is for how long scans wait until they are published.
        """
        self._client = client
        self._drops = drops
        self._frames = frames
        self._reader = MessageReader(path_poses=MAX_KEYFRAMES)
        self._lock = threading.Lock()
        self._sources: dict[str, SourcePoses] = {}
        self._body_from_sensor: dict[str, Doubles] = {}
        self._map_frame = ""
        self._arrived: _Arrived | None = None  # the newest that was not read
        self._frame_jumps = FrameJumps(wait_s + _PERIOD_S)
        self._map_from_robot: Doubles | None = None
        self._stopping = threading.Event()
        # It waits for the server for as long as a correction takes.
        self._thread = threading.Thread(target=self._run, name="ros2-corrections", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Correct nothing more."""
        self._stopping.set()
        self._thread.join(_LEAVE_S)

    def published(self, placed: Placed, scan: PosedScan, map_frame: str, body_frame: str) -> None:
        """Take the pose of a sweep that was published as a scan."""
        stamp_ns = placed.sweep.stamp_ns
        try:
            at = np.array([stamp_ns], np.int64)
            map_from_body = self._frames.poses(map_frame, body_frame, at)[0]
        except NoScanError as error:
            text = f"its scans cannot be corrected: {error}: --body-frame names that of the path"
            self._drops.remark(placed.topic_name, text, _REFUSED)
            return
        name = source_of_topic(placed.topic_name)
        with self._lock:
            source = self._sources.get(name)
            if source is None or stamp_ns < source.newest_ns:  # it was started again
                source = self._sources[name] = SourcePoses()
            source.add(stamp_ns, scan.world_from_sensor)
            self._body_from_sensor[name] = np.linalg.inv(map_from_body) @ scan.world_from_sensor
            self._map_frame = map_frame
            self._map_from_robot = scan.world_from_sensor

    def take_jumps(self, transforms: list[Transform]) -> None:
        """Go on with transforms, by one of which the frame of odometry may jump."""
        if self._map_from_robot is None:
            return
        for transform in transforms:
            if transform.parent == self._map_frame:
                self._frame_jumps.add(transform, self._map_from_robot, time.monotonic())

    def receive(self, topic_name: str, payload: zenoh.ZBytes) -> None:
        """Take the message of a path; the one before is dropped if it was not read yet."""
        self._take(topic_name, partial(self._read, payload))

    def follow(self, topic_name: str, path: BodyPath) -> None:
        """Take a path that the clouds of a topic have told, as :meth:`receive` does."""
        self._take(topic_name, lambda: path)

    def _take(self, topic_name: str, read: Callable[[], BodyPath | None]) -> None:
        with self._lock:
            until_ns = {name: poses.newest_ns for name, poses in self._sources.items()}
            self._arrived = _Arrived(topic_name, read, until_ns)

    def _read(self, payload: zenoh.ZBytes) -> BodyPath | None:
        """Return the path of a message; None where it has no poses yet.

        Raises:
            NoScanError: it cannot be read.
            InvalidScanError: one of its poses is none.
        """
        found = self._reader.transforms(PATH, decode_cdr(payload.to_bytes(), PATH), 0)
        if not found:
            return None
        numbers = [each.numbers() for each in found]
        stamps_ns, first = np.unique([each.stamp_ns for each in found], return_index=True)
        positions, turns = (np.array(part)[first] for part in zip(*numbers, strict=True))
        return BodyPath(found[0].parent, stamps_ns, pose_matrices(positions, turns))

    def _run(self) -> None:
        pause_s = _PERIOD_S
        while not self._stopping.wait(pause_s):
            with self._lock:
                arrived, self._arrived = self._arrived, None
            began_s = time.monotonic()
            jumped = self._jump(began_s)
            if arrived is None and not jumped:
                continue
            try:
                if arrived is not None:
                    self._follow(arrived)
                self._correct()
                # At most half of the time the server makes its map again.
                pause_s = max(_PERIOD_S, time.monotonic() - began_s)
            except Exception as error:  # whatever numbers came
                told = error if isinstance(error, NoScanError | TriquadError) else repr(error)
                name = ALL_TF if arrived is None else arrived.topic_name
                self._drops.remark(name, f"no pose was corrected: {told}", _REFUSED)
                pause_s = _RETRY_S
                with self._lock:
                    self._arrived = self._arrived or arrived

    def _jump(self, now_s: float) -> bool:
        """Want scans where the jumps that are due move them; return whether there are any."""
        due = self._frame_jumps.due(now_s)
        with self._lock:
            for jump in due:
                for source in self._sources.values():
                    source.jump(jump)
        return bool(due)

    def _follow(self, arrived: _Arrived) -> None:
        """Want scans where a path has them.

        Raises:
            NoScanError: it cannot be read, is in another frame than the map, or of other times.
            InvalidScanError: one of its poses is none.
        """
        path = arrived.read()
        if path is None or not arrived.until_ns:
            return
        stamps_ns, parent_from_body = path.stamps_ns, path.parent_from_body
        with self._lock:
            if path.parent != self._map_frame:
                raise NoScanError(
                    "other_frame",
                    f"the path is in {path.parent!r}, and the map is made in "
                    f"{self._map_frame!r}: map in the frame of the path with --map-frame",
                )
            known = [
                self._sources[name].follow(
                    Poses(stamps_ns, parent_from_body @ self._body_from_sensor[name]), until_ns
                )
                for name, until_ns in arrived.until_ns.items()
            ]
        if not any(known):
            raise NoScanError(
                "other_times",
                f"the path has {stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s, and no "
                "scan came then: its poses need the stamps of the scans",
            )

    def _correct(self) -> None:
        """Have the server correct what is not where it should be.

        Raises:
            TriquadError: it does not.
        """
        with self._lock:
            found = [(*each, each[1].to_correct()) for each in self._sources.items()]
        for name, source, poses in found:
            if poses is None:
                continue
            stamps_s = poses.stamps_ns / 1e9
            reply = self._client.correct_poses(name, stamps_s, poses.world_from_sensor)
            _log.info("%s: scans moved with the path: %d", name, reply.scans_moved)
            with self._lock:
                source.corrected(poses)
