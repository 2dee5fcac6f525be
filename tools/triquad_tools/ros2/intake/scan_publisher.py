"""Publishing the scans of topics to the map server."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from triquad_client import Client
from triquad_format.records.arrays import Doubles

from triquad_tools.console.arguments import Place as Origin
from triquad_tools.sensors.ray_check import RayCheck, as_rays
from triquad_tools.sensors.ros.type_store import source_of_topic
from triquad_tools.sensors.sweep import NoScanError, PosedScan, Sweep

MAX_TOPICS = 64  # topics of which scans are made at most
_NOWHERE_ELSE = 0.0, 0.0, 0.0
_RESTART_NS = 10**9  # stamps that go back by more start again: a wrong one silences for no longer


@dataclass(frozen=True)
class Place:
    """The position of the robot."""

    map_frame: str
    position_m: Doubles  # [3] map frame
    stamp_ns: int


def refuse_late(back_ns: int) -> None:
    """Refuse a sweep that is so far before the one before, where that is no other start.

    Raises:
        NoScanError: it is a little before.
    """
    if 0 < back_ns <= _RESTART_NS:
        raise NoScanError("time_backwards", f"{back_ns / 1e9:.3g} s before the scan before")


@dataclass
class _Source:
    name: str
    read_ns: int  # newest stamp of a sweep that was read, since time went back
    sent_ns: int = 0  # and of one that was published: sweeps wait in between


class ScanPublisher:
    """Publishes scans to the map server, those of a topic in the order of their stamps."""

    def __init__(self, client: Client, ray_origins: Mapping[str, Origin], map_frame: str) -> None:
        """``ray_origins`` [3] say by topic where rays begin, in its frame; others are checked.

        ``map_frame`` is the one that was chosen; "": none was.
        """
        # Where the newest scan was taken; before there is one, the middle of a frame that is known.
        self.newest = Place(map_frame, np.zeros(3), stamp_ns=0) if map_frame else None
        self.count = 0  # scans that were published
        self._client = client
        self._rays = RayCheck()
        self._ray_origins = ray_origins
        self._sources: dict[str, _Source] = {}

    def time_went_back(self, topic_name: str, stamp_ns: int) -> bool:
        """Return whether a topic was started again, given the stamp of a sweep that is read.

        Raises:
            NoScanError: it is a little before the one before, or of too many topics.
        """
        source = self._sources.get(topic_name)
        if source is None:
            if len(self._sources) >= MAX_TOPICS:
                others = f"there are {len(self._sources)} others already: choose some with --clouds"
                raise NoScanError("too_many_topics", others)
            source = self._sources[topic_name] = _Source(source_of_topic(topic_name), stamp_ns)
        back_ns, source.read_ns = source.read_ns - stamp_ns, max(source.read_ns, stamp_ns)
        refuse_late(back_ns)
        source.read_ns = stamp_ns
        return back_ns > 0

    def see(self, topic_name: str, sweep: Sweep, *, is_depth: bool) -> None:
        """Look at the rays of a sweep, of which nothing is published yet."""
        self._rays.see(topic_name, sweep.points, is_depth=is_depth)

    def publish(
        self, topic_name: str, placed: PosedScan, stamp_ns: int, map_frame: str
    ) -> PosedScan:
        """Publish a scan; return it as it was published, seen from where its rays begin.

        Raises:
            NoScanError: it is empty, or its rays begin elsewhere than is said.
            TriquadError: it could not be sent.
        """
        problem = None if topic_name in self._ray_origins else self._rays.problem(topic_name)
        if problem is not None:
            raise problem
        scan = as_rays(placed, self._ray_origins.get(topic_name, _NOWHERE_ELSE))
        if len(scan.points) == 0:
            raise NoScanError("empty", "no point of it is finite")
        source = self._sources[topic_name]
        if stamp_ns < source.sent_ns:
            self._client.restart_source(source.name)
        source.sent_ns = stamp_ns
        self._client.publish_scan(
            scan.points, scan.world_from_sensor, stamp_ns / 1e9, source=source.name
        )
        self.count += 1
        self.newest = Place(map_frame, scan.world_from_sensor[:3, 3], stamp_ns)
        return scan
