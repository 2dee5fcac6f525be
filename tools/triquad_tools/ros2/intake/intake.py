"""Turning messages of ROS 2 into scans that are published once their poses are known."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import zenoh
from triquad_client import Client, InvalidScanError
from triquad_format.errors import TriquadError

from triquad_tools.ros2.attachment import SequenceGaps
from triquad_tools.ros2.intake.drop_log import DropLog
from triquad_tools.ros2.intake.first_scan import FirstScan
from triquad_tools.ros2.intake.message_queue import Arrival, MessageQueue, QueueLimits
from triquad_tools.ros2.intake.message_reader import MAX_POINTS, MessageReader
from triquad_tools.ros2.intake.motion import Motion
from triquad_tools.ros2.intake.placement import Placed, Placement
from triquad_tools.ros2.intake.scan_publisher import Place, ScanPublisher
from triquad_tools.ros2.intake.topic_listener import TopicListener
from triquad_tools.ros2.node import Node
from triquad_tools.ros2.options import BridgeOptions
from triquad_tools.ros2.topic_choice import Role
from triquad_tools.sensors.errors import NoScanError

_log = logging.getLogger("triquad_ros2")

_OTHER_BYTES = 1_000_000  # of a message of transforms, and of a cloud without its points
_SCAN_BYTES = 64 * MAX_POINTS + _OTHER_BYTES  # drivers write up to 64 bytes for each point
_SCANS_UNREAD = QueueLimits(16, 256_000_000)
_OTHERS_UNREAD = QueueLimits(4096, 16_000_000)  # 4 s of transforms at 1 kHz
_WAITING_BYTES = 512_000_000  # of sweeps that wait for their transforms
_TICK_S = 0.2


class Intake:
    """Receives what a robot publishes, on a thread of its own."""

    def __init__(
        self, session: zenoh.Session, client: Client, options: BridgeOptions, node: Node
    ) -> None:
        """Begin to receive messages."""
        frame = options.scans.map_frame
        self._start = Place(frame, np.zeros(3), stamp_ns=0) if frame else None
        self.drops = DropLog()
        self.scans = ScanPublisher(client)
        self._motion = Motion(from_topic=options.topics.poses is not None)
        self._reader = MessageReader(options.scans)
        self._placement = Placement(
            self._motion, map_frame=frame, max_bytes=_WAITING_BYTES, timeout_s=options.scans.wait_s
        )
        self._queue = MessageQueue(_SCANS_UNREAD, _OTHERS_UNREAD, self._pushed_out)
        self._gaps = SequenceGaps()
        self._gaps_lock = threading.Lock()
        self._first_scan = FirstScan(options.topics, time.monotonic())
        self._stopping = threading.Event()
        self._listener = TopicListener(session, options.topics, node, self._receive)
        self._thread = threading.Thread(target=self._run, name="ros2-intake")
        self._thread.start()

    @property
    def place(self) -> Place | None:
        """The place of the newest scan; None before there is one, and no map frame is set."""
        return self.scans.newest or self._start

    def close(self) -> None:
        """Take no more messages."""
        self._listener.close()
        self._stopping.set()
        self._queue.close()
        self._thread.join()

    def _receive(self, arrival: Arrival) -> None:
        """Keep a message for the thread that reads it."""
        limit = _OTHER_BYTES
        if arrival.role.brings_scans:
            limit = _SCAN_BYTES
            with self._gaps_lock:
                missed = self._gaps.missed(arrival.attachment)
            if missed:
                text = "their numbers are missing"
                self.drops.add(arrival.topic_name, "not_received", text, missed)
        if len(arrival.payload) > limit:
            text = f"{len(arrival.payload)} bytes exceed {limit}"
            self.drops.add(arrival.topic_name, "too_large", text)
        else:
            self._queue.put(arrival)

    def _pushed_out(self, arrival: Arrival) -> None:
        self.drops.add(arrival.topic_name, "pushed_out", "too many messages wait")

    def _run(self) -> None:
        while not self._stopping.is_set():
            arrival = self._queue.take(_TICK_S)
            if arrival is not None:
                self._guard(arrival.topic_name, partial(self._read, arrival))
            for placed in self._placement.settle(time.monotonic()):
                self._guard(placed.topic_name, partial(self._publish, placed))
            self._first_scan.check(self._listener.found, time.monotonic())

    def _publish(self, placed: Placed) -> None:
        if isinstance(placed.outcome, NoScanError):
            raise placed.outcome
        stamp_ns = placed.sweep.stamp_ns
        self.scans.publish(placed.topic_name, placed.outcome, stamp_ns, placed.map_frame)

    def _guard(self, topic_name: str, step: Callable[[], None]) -> None:
        """Do something with a message; no bytes may stop the intake."""
        try:
            step()
        except NoScanError as error:
            self.drops.add(topic_name, error.reason, error)
        except InvalidScanError as error:
            self.drops.add(topic_name, "invalid", error)
        except TriquadError as error:
            self.drops.add(topic_name, "not_sent", error)
        except Exception as error:
            self.drops.add(topic_name, "internal", repr(error))
            _log.debug("a message of %s could not be used", topic_name, exc_info=True)

    def _read(self, arrival: Arrival) -> None:
        if arrival.role.brings_scans:
            self._read_sweep(arrival)
        elif arrival.role is Role.CAMERA_INFO:
            self._reader.remember_camera(arrival)
        else:
            is_body = arrival.role is Role.POSE
            self._motion.add(self._reader.transforms(arrival), is_body=is_body)

    def _read_sweep(self, arrival: Arrival) -> None:
        self._first_scan.came(arrival.topic_name)
        sweep = self._reader.sweep(arrival)
        if self.scans.time_went_back(arrival.topic_name, sweep.stamp_ns):
            self.drops.remark(arrival.topic_name, "time went back, it starts again")
            self._placement.give_up_after(arrival.topic_name, sweep.stamp_ns)
            self._motion.forget_after(sweep.stamp_ns)
        self._placement.add(arrival.topic_name, sweep, time.monotonic())
