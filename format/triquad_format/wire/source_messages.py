"""The wire messages about sources of scans; see :mod:`triquad_format.wire.messages`."""

from dataclasses import dataclass
from typing import Annotated

from triquad_format.wire.codec import Message
from triquad_format.wire.messages import Count, FinitePositions, Integers, Name, Pose
from triquad_format.wire.query_messages import FiniteCorners
from triquad_format.wire.reply import MAX_COUNT, AtMostAsked, RigidPose, RowsOf, Within


@dataclass(frozen=True)
class SourcesRequest(Message):
    """Ask where the sources of scans have been, and for the newest scan of each."""

    server: str  # of the reply before, to which revision belongs; empty at first
    revision: int  # of the reply before: what was reported up to it is known; 0 at first
    max_points: int  # of each newest scan


@dataclass(frozen=True)
class ScanSample(Message):
    """Some of the points of a scan that is in the map."""

    stamp_ns: int  # nanoseconds since 1970, as its publisher said
    world_from_sensor: Annotated[Pose, RigidPose()]
    # [N, 3] metres, map frame, relative to the sensor's position
    points: Annotated[FinitePositions, AtMostAsked("max_points")]
    points_used: Count  # of the scan, by the map: N or more


@dataclass(frozen=True)
class SourceState(Message):
    """The changes of one source of scans."""

    scans: Count  # that were accepted into the map since the server heard of the source
    whole: bool  # what was reported of this source before is void
    trail: FiniteCorners  # [N, 3] metres, map frame: positions of the sensor, oldest first
    # [N] the piece of the trail each is part of: rises where the sensor jumped
    pieces: Annotated[Integers, Within(0, MAX_COUNT), RowsOf("trail")]
    newest: ScanSample | None  # where it is new


@dataclass(frozen=True)
class SourcesReply(Message):
    """Answer to :class:`SourcesRequest`: all sources that there are, by name."""

    server: Name
    revision: Count  # for the next request
    sources: dict[Name, SourceState]
