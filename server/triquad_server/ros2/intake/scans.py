"""Scans made of placed sweeps, numbered by source, on their way into the queue."""

import secrets
from dataclasses import dataclass, field

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.wire.messages import Scan
from triquad_tools.sensors.errors import NoScanError
from triquad_tools.sensors.ros.topic import source_of_topic
from triquad_tools.sensors.sweep import PosedScan, Sweep

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.rays import check_count
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.ros2.intake.losses import Losses
from triquad_server.ros2.intake.placement import Placed

WENT_BACK_NS = 10**9
"""Sweeps that go back by more begin anew; a stamp that was wrong silences no sensor for longer."""


def _new_session() -> int:
    return secrets.randbits(48)


@dataclass(frozen=True)
class Place:
    """Where the robot is."""

    map_frame: str
    position_m: Doubles  # [3] map frame
    stamp_ns: int


@dataclass
class _Source:
    """A topic of which scans are made."""

    name: str
    read_ns: int  # newest stamp of a sweep that was read, since time went back
    entered_ns: int  # and of one that was entered, in this session: sweeps wait in between
    session: int = field(default_factory=_new_session)
    sequence: int = 0  # of the next scan

    def advance(self, stamp_ns: int) -> None:
        """Go on to a sweep that is entered, in a new session where time went back."""
        if stamp_ns < self.entered_ns - WENT_BACK_NS:
            self.session, self.sequence, self.entered_ns = _new_session(), 0, stamp_ns
        self.entered_ns = max(self.entered_ns, stamp_ns)


class ScanMaker:
    """Puts scans into the queue, and accounts there for those that cannot be placed."""

    def __init__(self, queue: ScanQueue, losses: Losses, *, max_points: int, max_sources: int):
        """Scans of more than ``max_points`` points, and of further sources, are refused."""
        self.place: Place | None = None  # where the newest scan was taken
        self._queue = queue
        self._losses = losses
        self._max_points = max_points
        self._max_sources = max_sources
        self._sources: dict[str, _Source] = {}

    def begins_anew(self, topic_name: str, sweep: Sweep) -> bool:
        """Whether time went back since the sweep of this topic that was read before.

        Raises:
            NoScanError: the topic cannot be a source of scans.
        """
        source = self._sources.get(topic_name)
        if source is None:
            source = self._sources[topic_name] = self._new_source(topic_name, sweep.stamp_ns)
        went_back = sweep.stamp_ns < source.read_ns - WENT_BACK_NS
        source.read_ns = sweep.stamp_ns if went_back else max(source.read_ns, sweep.stamp_ns)
        return went_back

    def enter(self, placed: Placed) -> None:
        """Put a scan into the queue; where there is none, the topic's losses have it.

        The sweeps of a topic are entered in the order in which they were read.
        """
        source = self._sources[placed.topic_name]
        source.advance(placed.sweep.stamp_ns)
        scan = self._scan(source, placed)
        source.sequence += 1
        try:
            if isinstance(placed.outcome, NoScanError):
                raise placed.outcome
            check_count(scan.points, None, self._max_points)
        except (NoScanError, ScanRefusedError) as error:
            self._queue.refuse(scan, error.reason, str(error))
            self._losses.say(placed.topic_name, error.reason, error)
            return
        self.place = Place(placed.map_frame, scan.world_from_sensor[:3, 3], scan.stamp_ns)
        self._queue.put(scan)

    def _scan(self, source: _Source, placed: Placed) -> Scan:
        """A scan; one without points where the sweep could not be placed."""
        outcome = placed.outcome
        if isinstance(outcome, NoScanError):
            outcome = PosedScan(np.empty((0, 3), np.float32), np.eye(4))
        return Scan(
            points=np.asarray(outcome.points, np.float32),
            world_from_sensor=outcome.world_from_sensor,
            stamp_ns=placed.sweep.stamp_ns,
            source=source.name,
            session=source.session,
            sequence=source.sequence,
        )

    def _new_source(self, topic_name: str, stamp_ns: int) -> _Source:
        if len(self._sources) >= self._max_sources:
            raise NoScanError("too_many_topics", f"there are {len(self._sources)} others already")
        return _Source(source_of_topic(topic_name), read_ns=stamp_ns, entered_ns=stamp_ns)
