"""Placed sweeps published as scans, each topic as a source of its own."""

from dataclasses import dataclass

from triquad_client import Client
from triquad_format.records.arrays import Doubles

from triquad_tools.ros2.intake.placement import Placed
from triquad_tools.ros2.intake.topic_listener import MAX_TOPICS
from triquad_tools.sensors.errors import NoScanError
from triquad_tools.sensors.ros.topic import source_of_topic
from triquad_tools.sensors.sweep import Sweep

RESTART_NS = 10**9
"""Stamps that go back by more start again; a wrong one silences no sensor for longer."""


@dataclass(frozen=True)
class Place:
    """The position of the robot."""

    map_frame: str
    position_m: Doubles  # [3] map frame
    stamp_ns: int


@dataclass
class _Source:
    """A topic of which scans are made."""

    name: str
    read_ns: int  # newest stamp of a sweep that was read, since time went back
    sent_ns: int = 0  # and of one that was published: sweeps wait in between

    def reads(self, stamp_ns: int) -> bool:
        """Go on to a sweep that is read; return whether time went back."""
        went_back = stamp_ns < self.read_ns - RESTART_NS
        self.read_ns = stamp_ns if went_back else max(self.read_ns, stamp_ns)
        return went_back


class ScanPublisher:
    """Publishes scans to the map server, those of a topic in the order in which they came."""

    def __init__(self, client: Client) -> None:
        self.newest: Place | None = None  # where the newest scan was taken
        self.count = 0  # scans that were published
        self._client = client
        self._sources: dict[str, _Source] = {}

    def time_went_back(self, topic_name: str, sweep: Sweep) -> bool:
        """Return whether time went back since the sweep of this topic that was read before.

        Raises:
            NoScanError: the topic cannot be a source of scans.
        """
        source = self._sources.get(topic_name)
        if source is None:
            if len(self._sources) >= MAX_TOPICS:
                others = f"there are {len(self._sources)} others already: choose some with --clouds"
                raise NoScanError("too_many_topics", others)
            source = _Source(source_of_topic(topic_name), read_ns=sweep.stamp_ns)
            self._sources[topic_name] = source
        return source.reads(sweep.stamp_ns)

    def publish(self, placed: Placed) -> None:
        """Publish a scan.

        Raises:
            NoScanError: there is none.
            TriquadError: it could not be sent.
        """
        scan, stamp_ns = placed.outcome, placed.sweep.stamp_ns
        if isinstance(scan, NoScanError):
            raise scan
        if len(scan.points) == 0:
            raise NoScanError("empty", "no point of it is finite")
        source = self._sources[placed.topic_name]
        if stamp_ns < source.sent_ns - RESTART_NS:
            self._client.restart_source(source.name)
        elif stamp_ns < source.sent_ns:
            back_s = (source.sent_ns - stamp_ns) / 1e9
            raise NoScanError("time_backwards", f"{back_s:.3g} s before the scan before")
        source.sent_ns = stamp_ns
        self._client.publish_scan(
            scan.points, scan.world_from_sensor, stamp_ns / 1e9, source=source.name
        )
        self.count += 1
        self.newest = Place(placed.map_frame, scan.world_from_sensor[:3, 3], stamp_ns)
