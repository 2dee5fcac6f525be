"""The wire messages about the sources of scans; see :mod:`triquad_format.wire.messages`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from triquad_format.wire import keys
from triquad_format.wire.bounds import MAX_COUNT, at_most_asked, rigid_pose, rows_of, text, within
from triquad_format.wire.codec import Message, Request
from triquad_format.wire.limits import MAX_SAMPLE_POINTS
from triquad_format.wire.messages import (
    Count,
    Epoch,
    FinitePoints,
    FinitePositions,
    Integers,
    Name,
    Pose,
    Ticket,
)
from triquad_format.wire.packing import ArraySpec

Quaternions = Annotated[NDArray[np.float64], ArraySpec("<f8", (None, 4)), within(-1.01, 1.01)]


@dataclass(frozen=True)
class NewestScan(Message):
    """The scan of a source that was accepted into the map last."""

    stamp_ns: int  # when it was taken, nanoseconds since 1970, as its publisher said
    world_from_sensor: Annotated[Pose, rigid_pose()]  # of the sensor in the map frame
    # [N, 3] some of those that the map uses, metres, map frame, relative to the sensor's position
    points: Annotated[FinitePositions, at_most_asked("max_points")]
    points_used: Count  # as many the map uses, in range, and thinned: N or more

    def __repr__(self) -> str:
        at = ", ".join(f"{metres:.2f}" for metres in self.position_m)
        return f"NewestScan({self.points_used} points used, taken at {at} m)"

    @property
    def position_m(self) -> NDArray[np.float64]:
        """The position of the sensor: [3] metres, map frame."""
        return self.world_from_sensor[:3, 3]

    @property
    def points_m(self) -> NDArray[np.float64]:
        """The points [N, 3], metres, map frame."""
        return np.asarray(self.position_m + self.points)


@dataclass(frozen=True)
class ScanSource(Message):
    """A source of scans, and where its sensor has been."""

    scans: Count  # that were accepted into the map since the server heard of the source
    trail: FinitePoints  # [N, 3] positions of the sensor, metres, map frame, oldest first
    # [N] the piece of the trail each is part of: rises where the sensor jumped
    pieces: Annotated[Integers, within(0, MAX_COUNT), rows_of("trail")]
    newest: NewestScan | None  # None: a reset forgot it, and no scan has come since
    corrections: Count = 0  # of its trail, since the server heard of the source

    def __repr__(self) -> str:
        return f"ScanSource({self.scans} scans, {len(self.trail)} places of its trail)"

    def lines(self) -> list[NDArray[np.float64]]:
        """Return the trail as lines to draw: [K, 3] a piece, the last one up to the newest scan."""
        lines = np.split(self.trail, np.flatnonzero(np.diff(self.pieces)) + 1)
        if self.newest is not None:
            lines[-1] = np.concatenate([lines[-1], self.newest.position_m[None]])
        return [line for line in lines if len(line)]


@dataclass(frozen=True)
class SourceReport(Message):
    """All sources of scans that a server knows of: the answer to :class:`SourcesRequest`."""

    server: Name  # the run of the server, within which revisions compare
    revision: Count  # rises with each scan that is accepted into the map
    sources: dict[Name, ScanSource]  # by name; empty where the request has this revision


@dataclass(frozen=True)
class SourcesRequest(Request[SourceReport], operation=keys.SOURCES, background=True):
    """Ask where the sources of scans have been, and for the newest scan of each."""

    server: str  # of the reply before, to which revision belongs; empty at first
    revision: int  # of the reply before, which is not sent again; 0 at first
    max_points: Annotated[int, within(0, MAX_SAMPLE_POINTS)]  # of each newest scan


@dataclass(frozen=True)
class CorrectPosesReply(Message):
    """Answer to :class:`CorrectPosesRequest`: what was corrected, and how to go back."""

    epoch: Epoch  # the first of the corrected map
    scans_moved: Count  # scans whose pose changed by more than a twentieth of a voxel
    scans_learnt: Count  # kept scans of which regions were made again
    kept_epoch: Epoch | None = None  # as which the map of before stays on disk; None: it does not
    undo: Annotated[str, text(4096)] | None = None  # how to go back to it, or why one cannot


@dataclass(frozen=True)
class CorrectPosesRequest(Request[CorrectPosesReply], operation=keys.CORRECT_POSES):
    """Make the map again as better poses of a source's scans would have made it."""

    source: Name
    stamps_ns: Integers  # [K] rising, nanoseconds since 1970
    positions: FinitePoints  # [K, 3] metres, of the sensor in the map frame
    quaternions: Quaternions  # [K, 4] of its rotations, x, y, z, w, unit
    onward: bool  # scans after the last of these poses move as that
    ticket: Ticket = 0
