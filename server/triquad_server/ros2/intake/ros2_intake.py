"""Scans from clouds and depth images of ROS 2, put into the queue once their poses are known."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import zenoh
from triquad_tools.sensors.errors import NoScanError

from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.ros2.attachment import SequenceGaps
from triquad_server.ros2.intake.feeds import Choice, Role
from triquad_server.ros2.intake.inbox import Arrival, Inbox, LaneLimit
from triquad_server.ros2.intake.listening import MAX_TOPICS, Listening
from triquad_server.ros2.intake.losses import Losses
from triquad_server.ros2.intake.motion import Motion
from triquad_server.ros2.intake.placement import Placement
from triquad_server.ros2.intake.reading import Reader
from triquad_server.ros2.intake.scans import Place, ScanMaker
from triquad_server.ros2.intake.silence import Silence
from triquad_server.ros2.node import Node
from triquad_server.settings import Ros2Settings

_log = logging.getLogger("triquad_server.ros2")

_POINT_BYTES = 64  # that drivers write for each point, at most
_OTHER_BYTES = 1_000_000  # of a message of transforms, and of a cloud without its points
_SCANS_WAITING = LaneLimit(messages=16, bytes=256_000_000)
_OTHERS_WAITING = LaneLimit(messages=4096, bytes=16_000_000)
_PLACEMENT_BYTES = 512_000_000  # of points that wait for transforms
_TICK_S = 0.2


class Ros2Intake:
    """Receives messages of ROS 2, makes scans of them and puts these into the queue."""

    def __init__(
        self,
        session: zenoh.Session,
        settings: Ros2Settings,
        queue: ScanQueue,
        *,
        max_points: int,
        arrived: Callable[[], None],
        node: Node,
    ) -> None:
        """Begin to receive; ``arrived`` is called after each scan that was queued.

        Clouds and images of more than ``max_points`` points are refused.
        """
        choice = Choice.of_settings(settings)
        self._arrived = arrived
        frame = settings.map_frame
        self._start = Place(frame, np.zeros(3), stamp_ns=0) if frame else None
        self._max_bytes = max_points * _POINT_BYTES + _OTHER_BYTES
        self._losses = Losses(queue.dropped)
        self._scans = ScanMaker(queue, self._losses, max_points=max_points, max_sources=MAX_TOPICS)
        self._motion = Motion(from_topic=choice.poses is not None)
        self._reader = Reader(
            max_points=max_points,
            depth_stride=settings.depth_stride,
            body_frame=settings.body_frame,
            by_arrival=settings.clock == "arrival",
        )
        self._placement = Placement(
            self._motion,
            map_frame=settings.map_frame,
            limit=LaneLimit(settings.waiting_clouds, _PLACEMENT_BYTES),
            timeout_s=settings.waiting_s,
        )
        self._inbox = Inbox(_SCANS_WAITING, _OTHERS_WAITING, self._pushed_out)
        self._gaps = SequenceGaps()
        self._gaps_lock = threading.Lock()
        self._silence = Silence(choice, time.monotonic())
        self._stopping = threading.Event()
        self._listening = Listening(session, choice, node, self._receive)
        self._thread = threading.Thread(target=self._run, name="ros2-intake")
        self._thread.start()

    @property
    def place(self) -> Place | None:
        """Where the newest scan was taken; None before there is one, and no map frame is set."""
        return self._scans.place or self._start

    def close(self) -> None:
        """Take no more messages."""
        self._listening.close()
        self._stopping.set()
        self._inbox.close()
        self._thread.join()

    def _receive(self, arrival: Arrival) -> None:
        """Keep a message for the thread that reads it."""
        if arrival.role.brings_scans:
            self._count_missed(arrival)
        limit = self._max_bytes if arrival.role.brings_scans else _OTHER_BYTES
        if len(arrival.payload) > limit:
            text = f"{len(arrival.payload)} bytes exceed {limit}"
            self._losses.add(arrival.topic_name, "too_large", text)
        else:
            self._inbox.put(arrival)

    def _count_missed(self, arrival: Arrival) -> None:
        with self._gaps_lock:
            missed = self._gaps.missed(arrival.attachment)
        if missed:
            text = "their numbers are missing"
            self._losses.add(arrival.topic_name, "not_received", text, missed)

    def _pushed_out(self, arrival: Arrival) -> None:
        self._losses.add(arrival.topic_name, "pushed_out", "too many messages wait")

    def _run(self) -> None:
        while not self._stopping.is_set():
            arrival = self._inbox.take(_TICK_S)
            if arrival is not None:
                self._guard(arrival.topic_name, partial(self._read, arrival))
            for placed in self._placement.settle(time.monotonic()):
                self._guard(placed.topic_name, partial(self._scans.enter, placed))
                self._arrived()
            self._silence.check(self._listening.found, time.monotonic())

    def _guard(self, topic_name: str, step: Callable[[], None]) -> None:
        """Do something with a message; whatever its bytes are must not stop the intake."""
        try:
            step()
        except NoScanError as error:
            self._losses.add(topic_name, error.reason, error)
        except Exception as error:
            self._losses.add(topic_name, "internal", repr(error))
            _log.debug("a message of %s could not be used", topic_name, exc_info=True)

    def _read(self, arrival: Arrival) -> None:
        if arrival.role.brings_scans:
            self._read_sweep(arrival)
        elif arrival.role is Role.CAMERA_INFO:
            self._reader.remember_camera(arrival)
        else:
            self._read_motion(arrival)

    def _read_sweep(self, arrival: Arrival) -> None:
        self._silence.end(arrival.topic_name)
        sweep = self._reader.sweep(arrival)
        if self._scans.begins_anew(arrival.topic_name, sweep):
            self._losses.remark(arrival.topic_name, "time went back, it begins anew")
            self._placement.give_up_after(arrival.topic_name, sweep.stamp_ns)
            self._motion.forget_after(sweep.stamp_ns)
        self._placement.add(arrival.topic_name, sweep, time.monotonic())

    def _read_motion(self, arrival: Arrival) -> None:
        is_body = arrival.role is Role.POSE
        self._motion.add(self._reader.transforms(arrival), is_body=is_body)
