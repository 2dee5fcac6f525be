"""The wire messages of questions about the map.

All of a reply comes from one epoch. Flags are 0 or 1. What was not found has a flag that says so:
no number stands for it.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from triquad_format.wire import keys
from triquad_format.wire.bounds import (
    MAX_COUNT,
    asked_by,
    rigid_pose,
    rows_of,
    same_as_asked,
    shape_asked_by,
    within,
)
from triquad_format.wire.codec import Request
from triquad_format.wire.limits import (
    MAX_DISTANCE_M,
    MAX_ITERATIONS,
    MAX_RANGE_M,
    MIN_LENGTH_M,
)
from triquad_format.wire.messages import (
    Count,
    Epoch,
    Epochs,
    FinitePoints,
    FinitePositions,
    Integers,
    Length,
    MapReply,
    Name,
    Point,
    Pose,
    Positions,
    Statuses,
    UpperCorner,
    Values,
)
from triquad_format.wire.packing import ArraySpec

Flags = Annotated[NDArray[np.uint8], ArraySpec("|u1", (None,))]
Volume = Annotated[NDArray[np.float32], ArraySpec("<f4", (None, None, None))]
StatusVolume = Annotated[NDArray[np.uint8], ArraySpec("|u1", (None, None, None))]
Counts = Annotated[NDArray[np.int32], ArraySpec("<i4", (3,))]
Covariance = Annotated[NDArray[np.float64], ArraySpec("<f8", (6, 6))]

UnitVectors = Annotated[Positions, within(-1.001, 1.001)]  # or zero
Shares = Annotated[Values, within(0, 1)]
TruthValues = Annotated[Flags, within(0, 1)]
Reach = Annotated[float, within(MIN_LENGTH_M, MAX_DISTANCE_M)]  # of a search, metres
PlacesAlong = Annotated[Values, within(0, 1.001 * MAX_RANGE_M), asked_by("starts")]


@dataclass(frozen=True)
class DistanceReply(MapReply):
    """Answer to :class:`DistanceRequest`."""

    # [N] metres, negative behind a surface; at most max_distance_m
    distance_m: Annotated[Values, within("-max_distance_m", "max_distance_m"), asked_by("points")]
    # [N, 3] its unit gradient, map frame; zero where nothing was found
    gradient: Annotated[UnitVectors, asked_by("points")]
    # [N] whether there is a surface within max_distance_m
    found: Annotated[TruthValues, asked_by("points")]
    status: Annotated[Statuses, asked_by("points")]  # [N] of the points themselves
    confidence: Annotated[Shares, asked_by("points")]  # [N] in [0, 1]
    # [N, 3] relative to origin; the point where nothing was found
    surface_point: Annotated[FinitePositions, asked_by("points")] | None
    # [N] metres, at most max_distance_m
    unknown_distance_m: Annotated[Values, within(0, "max_distance_m"), asked_by("points")] | None
    # [N, 3] relative to origin; the point where there is none
    unknown_point: Annotated[FinitePositions, asked_by("points")] | None


@dataclass(frozen=True)
class DistanceRequest(Request[DistanceReply], operation=keys.DISTANCE):
    """True distances to the nearest seen surface, at any range."""

    origin: Point  # metres, map frame
    points: Positions  # [N, 3] metres, relative to origin
    max_distance_m: Reach  # a surface is searched for up to here
    surface_point: bool  # the nearest points of the surface are wanted, too
    unknown_distance: bool  # so is the nearest unknown space
    epoch: int


@dataclass(frozen=True)
class SpheresReply(MapReply):
    """Answer to :class:`SpheresRequest`."""

    status: Annotated[Statuses, asked_by("centres")]  # [N]


@dataclass(frozen=True)
class SpheresRequest(Request[SpheresReply], operation=keys.SPHERES):
    """Ask what spheres contain."""

    origin: Point  # metres, map frame
    centres: Positions  # [N, 3] metres, relative to origin
    radii_m: Annotated[Values, within(0, MAX_DISTANCE_M), rows_of("centres")]  # [N] metres
    epoch: int


@dataclass(frozen=True)
class SegmentsReply(MapReply):
    """Answer to :class:`SegmentsRequest`; places are metres along the segment."""

    length_m: PlacesAlong  # [N]
    blocked: Annotated[TruthValues, asked_by("starts")]  # [N] the ball touches a seen surface
    contact_m: PlacesAlong  # [N] where it first does; the length where it does not
    # [N] least distance of the centre to a surface, up to the contact
    clearance_m: Annotated[Values, within("-max_distance_m", "max_distance_m"), asked_by("starts")]
    clearance_at_m: PlacesAlong  # [N] where
    # [N] the ball enters unknown space, before any contact
    meets_unknown: Annotated[TruthValues, asked_by("starts")]
    unknown_contact_m: PlacesAlong  # [N] where it first does; the length where it does not


@dataclass(frozen=True)
class SegmentsRequest(Request[SegmentsReply], operation=keys.SEGMENTS):
    """Ask what a ball meets that moves along segments."""

    origin: Point  # metres, map frame
    starts: Positions  # [N, 3] metres, relative to origin
    ends: Annotated[Positions, rows_of("starts")]  # [N, 3]
    radius_m: Annotated[float, within(0, MAX_DISTANCE_M)]  # of the ball
    max_distance_m: Reach  # clearance is searched for up to here
    epoch: int


@dataclass(frozen=True)
class RaysReply(MapReply):
    """Answer to :class:`RaysRequest`."""

    range_m: Annotated[Values, within(0, "max_range_m"), asked_by("starts")]  # [N] metres
    # [N] what it ends at: surface, unknown space, or the largest range (free)
    status: Annotated[Statuses, asked_by("starts")]


@dataclass(frozen=True)
class RaysRequest(Request[RaysReply], operation=keys.RAYS):
    """Ask how far rays reach."""

    origin: Point  # metres, map frame
    starts: Positions  # [N, 3] metres, relative to origin
    directions: Annotated[Positions, rows_of("starts")]  # [N, 3] unit vectors, map frame
    max_range_m: Annotated[float, within(MIN_LENGTH_M, MAX_RANGE_M)]
    through_unknown: bool  # unknown space does not stop them
    epoch: int


@dataclass(frozen=True)
class GroundReply(MapReply):
    """Answer to :class:`GroundRequest`."""

    # [N] surface: there is ground; free: there is none; else unknown
    status: Annotated[Statuses, asked_by("points")]
    # [N] metres down to the ground, a little up where the point lies in it; else as far as all was
    # seen to be free
    drop_m: Annotated[Values, within(-MAX_DISTANCE_M, "max_drop_m"), asked_by("points")]
    # [N, 3] of the ground, unit vectors, map frame; zero where there is none
    normal: Annotated[UnitVectors, asked_by("points")]
    confidence: Annotated[Shares, asked_by("points")]  # [N] in [0, 1]; 0 where there is no ground


@dataclass(frozen=True)
class GroundRequest(Request[GroundReply], operation=keys.GROUND):
    """The ground below points."""

    origin: Point  # metres, map frame
    points: Positions  # [N, 3] metres, relative to origin
    max_drop_m: Reach  # the ground is searched for up to here
    epoch: int


@dataclass(frozen=True)
class GridReply(MapReply):
    """Answer to :class:`GridRequest`."""

    # [x, y, z] metres, as in DistanceReply
    distance_m: Annotated[
        Volume, within("-max_distance_m", "max_distance_m"), shape_asked_by("counts")
    ]
    status: Annotated[StatusVolume, within(0, 2), shape_asked_by("counts")]  # [x, y, z]


@dataclass(frozen=True)
class GridRequest(Request[GridReply], operation=keys.GRID):
    """Distance and status at the middles of a grid's cells."""

    corner: Annotated[Point, within()]  # the grid's least corner, metres, map frame
    cell_m: Reach
    counts: Annotated[Counts, within(1)]  # cells along x, y, z
    max_distance_m: Reach
    epoch: int


@dataclass(frozen=True)
class AlignReply(MapReply):
    """Answer to :class:`AlignRequest`."""

    world_from_sensor: Annotated[Pose, rigid_pose()]
    # of translation (metres) and rotation vector (radians), map frame
    covariance: Annotated[Covariance, within()]
    inlier_share: Annotated[float, within(0, 1)]
    rms_m: Length  # of the inliers' distances
    converged: bool
    iterations: Annotated[int, within(0, MAX_ITERATIONS)]
    points: Count  # that were used


@dataclass(frozen=True)
class AlignRequest(Request[AlignReply], operation=keys.ALIGN):
    """Find the pose of a scan near a guess."""

    points: Positions  # [N, 3] metres, sensor frame
    world_from_sensor: Annotated[Pose, rigid_pose()]  # the guess
    max_distance_m: Reach  # points farther from any surface do not count
    epoch: int


@dataclass(frozen=True)
class ChangesReply(MapReply):
    """Answer to :class:`ChangesRequest`: boxes around voxels that changed."""

    server: Name
    since: Annotated[Epoch, same_as_asked("since")]
    minimum: FinitePoints  # [N, 3] metres, map frame
    maximum: Annotated[FinitePoints, rows_of("minimum")]  # [N, 3]
    # [N] 1: surface appeared, 0: it vanished
    appeared: Annotated[TruthValues, rows_of("minimum")]
    epochs: Annotated[Epochs, rows_of("minimum")]  # [N] of the newest change in each
    # [N] that changed in each
    voxels: Annotated[Integers, within(0, MAX_COUNT), rows_of("minimum")]


@dataclass(frozen=True)
class ChangesRequest(Request[ChangesReply], operation=keys.CHANGES):
    """Ask where surface appeared or vanished since an epoch."""

    # number of an epoch; 0: the newest, after which nothing has changed yet
    since: Annotated[int, within(0)]
    server: str  # of the reply or status that named it; empty where that is not known
    minimum: Point
    maximum: UpperCorner  # of the box that is of interest, map frame; an open side is infinite
