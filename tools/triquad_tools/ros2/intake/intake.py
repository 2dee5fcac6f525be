"""Turning messages of ROS 2 into scans, which are published once their poses are known."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import zenoh
from triquad_client import Client, InvalidScanError
from triquad_format.errors import TriquadError
from triquad_format.wire.limits import MAX_KEYFRAMES

from triquad_tools.ros2.intake.corrections import Corrections
from triquad_tools.ros2.intake.drop_log import LOG_PERIOD_S, DropLog, FirstScan
from triquad_tools.ros2.intake.live_odometry import LiveOdometry
from triquad_tools.ros2.intake.placement import Motion, Placed, Placement
from triquad_tools.ros2.intake.scan_publisher import Place, ScanPublisher
from triquad_tools.ros2.intake.topic_listener import Arrival, Limits, MessageQueue, TopicListener
from triquad_tools.ros2.node import Node
from triquad_tools.ros2.options import TYPES, BridgeOptions, Role
from triquad_tools.ros2.topics import SequenceGaps
from triquad_tools.sensors.motion.track import Transform
from triquad_tools.sensors.ros.from_bytes import decode_cdr
from triquad_tools.sensors.ros.message_reader import MessageReader
from triquad_tools.sensors.ros.type_store import ALL_TF
from triquad_tools.sensors.sweep import NoScanError, Sweep

_log = logging.getLogger("triquad_ros2")
MAX_POINTS = 2_500_000  # of a scan: a message of 30 MB, which servers receive by default
_OTHER_BYTES = 1_000_000  # of a message of transforms, and of a cloud without its points
_PATH_BYTES = 120 * MAX_KEYFRAMES  # with names of frames
_SCAN_BYTES = 64 * MAX_POINTS + _OTHER_BYTES  # drivers write up to 64 bytes for each point
_SCANS_UNREAD = Limits(16, 256_000_000)
_OTHERS_UNREAD = Limits(4096, 16_000_000)  # 4 s of transforms at 1 kHz
_WAITING_BYTES = 512_000_000  # of sweeps that wait for their transforms
_TICK_S = 0.2
_ODOMETRY_MAP = "map"  # the frame that odometry's poses are in, where no other was chosen
_PATH_POSES = 100  # of a path, whose messages have all of them again and again


class Intake:
    """Receives what a robot publishes, on a thread of its own."""

    def __init__(
        self, session: zenoh.Session, client: Client, options: BridgeOptions, node: Node
    ) -> None:
        """Begin to receive messages."""
        self._options = options
        topics, found_by = options.topics, options.topics.odometry
        frame = options.map_frame or (_ODOMETRY_MAP if found_by else "")
        self.drops = DropLog()
        self.scans = ScanPublisher(client, options.ray_origins, frame)
        self._motion = Motion(from_topic=bool(topics.poses or found_by), map_frame=frame)
        frames = self._motion.frames
        self._odometry = LiveOdometry(found_by, frames, options, frame) if found_by else None
        self._reader = MessageReader(
            stride=options.depth_stride,
            body_frame=options.body_frame,
            by_arrival=options.clock == "arrival",
            max_points=MAX_POINTS,
            path_poses=_PATH_POSES,
        )
        self._placement = Placement(
            self._motion, map_frame=frame, max_bytes=_WAITING_BYTES, timeout_s=options.wait_s
        )
        self._queue = MessageQueue(
            _SCANS_UNREAD,
            _OTHERS_UNREAD,
            lambda gone: self.drops.add(gone.topic_name, "pushed_out", "too many messages wait"),
        )
        self._gaps = SequenceGaps()
        self._first_scan = FirstScan(options.topics, time.monotonic())
        self._check_s = time.monotonic() + LOG_PERIOD_S  # when the transforms are checked next
        self._corrections = (
            Corrections(client, self.drops, frames, options.wait_s)
            if topics.corrections or (found_by and options.close_loops)
            else None
        )
        self._listener = TopicListener(session, options.topics, node, self._receive)
        self._thread = threading.Thread(target=self._run, name="ros2-intake")
        self._thread.start()

    @property
    def published(self) -> int:
        """The number of scans that were published to the server."""
        return self.scans.count

    @property
    def dropped(self) -> dict[str, int]:
        """The messages of which no scan could be published, by reason."""
        return self.drops.counts()

    @property
    def place(self) -> Place | None:
        """The place of the newest scan; None before there is one, and no map frame is set."""
        return self.scans.newest

    def close(self) -> None:
        """Take no more messages."""
        self._listener.close()
        self._queue.close()
        self._thread.join()
        if self._corrections is not None:
            self._corrections.close()

    def _receive(self, arrival: Arrival) -> None:
        limit = _OTHER_BYTES
        if arrival.role.brings_scans:
            limit = _SCAN_BYTES
            if missed := self._gaps.missed(arrival.attachment):
                text = "their numbers are missing"
                self.drops.add(arrival.topic_name, "not_received", text, missed)
        if arrival.role is Role.CORRECTION:
            limit = _PATH_BYTES
        if len(arrival.payload) > limit:
            text = f"{len(arrival.payload)} bytes exceed {limit}"
            self.drops.add(arrival.topic_name, "too_large", text)
        elif self._corrections is not None and arrival.role is Role.CORRECTION:
            self._corrections.receive(arrival.topic_name, arrival.payload)
        else:
            self._queue.put(arrival)

    def _run(self) -> None:
        while not self._queue.is_closed:
            arrival = self._queue.take(_TICK_S)
            if arrival is not None:
                self._guard(arrival.topic_name, partial(self._read, arrival))
            for placed in self._placement.settle(time.monotonic()):
                self._guard(placed.topic_name, partial(self._publish, placed))
            now_s = time.monotonic()
            self._first_scan.check(self._listener.found, now_s)
            if now_s >= self._check_s:
                self._check_s = now_s + LOG_PERIOD_S
                for edge in self._motion.frames.moving:
                    if problem := edge.problem():
                        self.drops.remark(edge.child, problem, "two_publishers")

    def _publish(self, placed: Placed) -> None:
        if isinstance(placed.outcome, NoScanError):
            raise placed.outcome
        name, stamp_ns = placed.topic_name, placed.sweep.stamp_ns
        frame = self._placement.map_frame
        scan = self.scans.publish(name, placed.outcome, stamp_ns, frame)
        if self._corrections is not None:
            body = self._odometry.body_frame if self._odometry else self._options.body_frame
            self._corrections.published(placed, scan, frame, body)

    def _guard(self, topic_name: str, step: Callable[[], None]) -> None:
        """Do something with a message; no bytes may stop the intake."""
        try:
            step()
        except NoScanError as error:
            self.drops.add(topic_name, error.reason, error)
        except TriquadError as error:
            reason = "invalid" if isinstance(error, InvalidScanError) else "not_sent"
            self.drops.add(topic_name, reason, error)
        except Exception as error:
            self.drops.add(topic_name, "internal", repr(error))
            _log.debug("a message of %s could not be used", topic_name, exc_info=True)

    def _read(self, arrival: Arrival) -> None:
        role, topic_name, came_ns = arrival.role, arrival.topic_name, arrival.arrived_ns
        if role.brings_scans:
            self._first_scan.came(topic_name)
        kind, message = _decoded(arrival)
        if role is Role.CAMERA_INFO:
            self._reader.cameras[topic_name] = message
        elif role.brings_scans:
            sweep = self._reader.sweep(topic_name, kind, message, came_ns)
            self.scans.see(topic_name, sweep, is_depth=role is Role.DEPTH)
            if self._odometry and topic_name == self._odometry.topic_name:
                self._follow_odometry(self._odometry, sweep)
            self._place(topic_name, sweep)
        else:
            static = role is Role.TF_STATIC
            found = self._reader.transforms(kind, message, came_ns, static=static)
            self._motion.add(found, is_body=role is Role.POSE)
            if self._corrections is not None and self._options.topics.corrections == ALL_TF:
                self._corrections.take_jumps(found)

    def _follow_odometry(self, odometry: LiveOdometry, sweep: Sweep) -> None:
        for found in odometry.take(sweep):
            if isinstance(found, Transform):
                self._motion.add([found], is_body=found.child == odometry.body_frame)
            elif self._corrections is not None:
                self._corrections.follow(odometry.topic_name, found)

    def _place(self, topic_name: str, sweep: Sweep) -> None:
        if self.scans.time_went_back(topic_name, sweep.stamp_ns):
            self.drops.remark(topic_name, "time went back, it starts again")
            self._placement.give_up_after(topic_name, sweep.stamp_ns)
            self._motion.frames.forget_after(sweep.stamp_ns)
        self._placement.add(topic_name, sweep, time.monotonic())


def _decoded(arrival: Arrival) -> tuple[str, Any]:
    """Return a message and which type of its role it has, or raise a NoScanError."""
    payload = arrival.payload.to_bytes()
    *others, last = (arrival.type_name,) if arrival.type_name else TYPES[arrival.role]
    for kind in others:
        with suppress(NoScanError):
            return kind, decode_cdr(payload, kind)
    return last, decode_cdr(payload, last)
