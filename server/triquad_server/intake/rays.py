"""Turns a scan into the rays that are used: checked, classified by range, thinned, transformed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.pose import is_rigid, moved_pose, rotation_error
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import empty_keys, enter

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.map_origin import first_origin, local_pose
from triquad_server.settings import ANY_SOURCE, ScanSettings, SourceSettings

_SHELL = 0.18
"""The logarithm of the ratio of a shell's outer to its inner radius."""

_NOWHERE = (np.inf, np.inf, np.inf), (-np.inf, -np.inf, -np.inf)
"""The corners of an empty box."""


@dataclass(frozen=True)
class RobotBox:
    """The space that the robot takes up while a scan is taken."""

    low: Doubles  # [3] its corners, metres, sensor frame
    high: Doubles
    world_from_sensor: Doubles  # [4, 4]

    @property
    def corners(self) -> Doubles:
        """The corners [8, 3] of the box, map frame."""
        corners = np.stack(np.meshgrid(*zip(self.low, self.high, strict=True)), -1).reshape(-1, 3)
        world: Doubles = corners @ self.world_from_sensor[:3, :3].T + self.world_from_sensor[:3, 3]
        return world

    def voxel_centres(self, leaf_m: float) -> Doubles:
        """Return the centres [N, 3], map frame, of the map's voxels that lie in it."""
        rotation, origin = self.world_from_sensor[:3, :3], self.world_from_sensor[:3, 3]
        corners = self.corners
        first = np.floor(corners.min(axis=0) / leaf_m).astype(np.int64)
        last = np.floor(corners.max(axis=0) / leaf_m).astype(np.int64)
        sides = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
        voxels = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
        centres: Doubles = (voxels + 0.5) * leaf_m
        inside = (centres - origin) @ rotation
        return centres[((inside >= self.low) & (inside <= self.high)).all(axis=1)]


@dataclass(frozen=True)
class ScanRays:
    """The usable rays of a scan, metres, from the map's origin."""

    origin: Doubles  # [3] the sensor
    ends: Doubles  # [N, 3] where rays met a surface
    points_dropped: dict[str, int]  # points and rays of the scan that are not used, by reason
    # [K, 3] the sensor's range on rays that met something beyond it
    far_ends: Doubles = field(default_factory=lambda: np.empty((0, 3)))
    # [M, 3] the range on rays that met nothing
    open_ends: Doubles = field(default_factory=lambda: np.empty((0, 3)))
    robot: RobotBox | None = None
    # [3] of the user's coordinates: all of the above counts from there
    map_origin: Doubles = field(default_factory=lambda: np.zeros(3))

    @property
    def free_corners(self) -> Doubles:
        """Points [K, 3] that bound the free space that no ray's end shows."""
        corners = [] if self.robot is None else [self.robot.corners]
        return np.concatenate([self.far_ends, self.open_ends, *corners])


def _check_pose(world_from_sensor: Doubles) -> None:
    pose = world_from_sensor
    if pose.shape != (4, 4):
        raise ScanRefusedError("pose_shape", f"the pose is {list(pose.shape)}, not [4, 4]")
    if not np.isfinite(pose).all():
        raise ScanRefusedError(
            "pose_not_finite", f"the pose has values that are not finite: {pose}"
        )
    if not is_rigid(pose):
        raise ScanRefusedError(
            "pose_not_rigid",
            f"the pose is not a rotation and a translation (rotation off by "
            f"{rotation_error(pose):.2g}, last row {pose[3]}); scale and shear are not allowed",
        )


def _check_shapes(points: Floats, no_return: Floats) -> None:
    for what, array in (("points", points), ("no_return", no_return)):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ScanRefusedError(f"{what}_shape", f"{what}: {list(array.shape)}, not [N, 3]")


def _unit_vectors(no_return: Floats) -> Doubles:
    """Return unit vectors [M, 3] along the rays without a return; refuse what is no direction."""
    vectors = no_return.astype(np.float64)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    good = np.isfinite(lengths[:, 0]) & (lengths[:, 0] > 0)
    if not good.all():
        index = int(good.argmin())
        raise ScanRefusedError(
            "bad_no_return",
            f"direction {index} of no_return is {no_return[index]}: a direction is finite and "
            "has a length",
        )
    unit: Doubles = vectors / lengths
    return unit


class _Limits(NamedTuple):
    """The limits that decide which points are used, in the form that the kernel takes."""

    range_min_m: float
    range_max_m: float
    thin_m: float
    by_direction: bool
    robot_low: Doubles  # [3] corners of the robot, sensor frame
    robot_high: Doubles


class _Selection(NamedTuple):
    """The points that are used, and by reason the number of others."""

    kept: Doubles  # [N, 3]
    beyond: Doubles  # [M, 3] where the rays to points that are too far leave the sensor's range
    not_finite: int
    no_range: int
    on_robot: int
    too_near: int
    too_far: int

    def dropped(self, **others: int) -> dict[str, int]:
        """Return how many points are not used, by reason, and how many ``others``."""
        reasons = ("not_finite", "no_range", "on_robot", "too_near", "too_far")
        counts = {reason: getattr(self, reason) for reason in reasons} | others
        return {reason: count for reason, count in counts.items() if count}


@kernel(inline="always")
def _is_within(x: float, y: float, z: float, low: Doubles, high: Doubles) -> bool:
    within: bool = low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]
    return within


@kernel(inline="always")
def _is_first(keys: Longs, x: float, y: float, z: float, distance: float, limits: _Limits) -> bool:
    """Return whether no point before lies in the same voxel or, if so set, in the same direction.

    For directions, points are put onto the inner sphere of a shell around the sensor and thinned.
    """
    scale = 1.0
    if limits.by_direction:
        scale = np.exp(np.floor(np.log(distance) / _SHELL) * _SHELL) / distance
    return bool(enter(keys, scale * x, scale * y, scale * z, limits.thin_m))


@kernel()
def _select(points: Floats, limits: _Limits, keys: Longs) -> _Selection:
    kept, beyond = np.empty((len(points), 3)), np.empty((len(points), 3))
    count = not_finite = no_range = on_robot = too_near = too_far = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        distance = np.sqrt(x * x + y * y + z * z)
        if not np.isfinite(distance):
            not_finite += 1
        elif distance == 0:  # which is "no return" to many sensors
            no_range += 1
        elif _is_within(x, y, z, limits.robot_low, limits.robot_high):
            on_robot += 1
        elif distance < limits.range_min_m:
            too_near += 1
        elif distance > limits.range_max_m:
            share = limits.range_max_m / distance
            beyond[too_far, 0], beyond[too_far, 1] = share * x, share * y
            beyond[too_far, 2] = share * z
            too_far += 1
        elif _is_first(keys, x, y, z, distance, limits):
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            count += 1
    return _Selection(
        kept[:count], beyond[:too_far], not_finite, no_range, on_robot, too_near, too_far
    )


def _thinned(kinds: Sequence[Doubles], limit: int) -> Sequence[Doubles]:
    """Return an even part of rays [N, 3] of some kinds, so that at most ``limit`` are left of all.

    One is drawn of each few in a row: every second one may be of every second laser.
    """
    step = -(-sum(map(len, kinds)) // limit)
    if step <= 1:
        return kinds
    drawn = []
    for rays in kinds:
        chosen = np.arange(0, len(rays), step)
        chosen += np.random.default_rng(0).integers(step, size=len(chosen))
        drawn.append(rays[np.minimum(chosen, len(rays) - 1)])
    return drawn


def _why_empty(
    points: int, disbelieved: int, settings: ScanSettings, source: SourceSettings
) -> str:
    """Return why nothing is left of a scan of ``points`` points, and which setting decides that."""
    box = " and outside of robot_box_m" if source.robot_box_m else ""
    rays = "there is no ray without a return"
    if disbelieved:
        rays = (
            f"{disbelieved} rays without a return are not believed, since the settings of the "
            "source have no_return = false"
        )
    return (
        f"none of {points} points is finite and at least range_min_m = {settings.range_min_m:g} m "
        f"from the sensor{box}, and {rays}"
    )


def _selected(points: Floats, settings: ScanSettings, source: SourceSettings) -> _Selection:
    """Return which of points [N, 3] are used, from where the source's rays begin."""
    if any(source.ray_origin_m):
        points = (points - np.array(source.ray_origin_m)).astype(np.float32)
    low, high = _robot_corners(source)
    limits = _Limits(
        settings.range_min_m,
        settings.range_max_m,
        settings.thin_m,
        by_direction=settings.thin_by == "direction",
        robot_low=low,
        robot_high=high,
    )
    given = np.ascontiguousarray(points).view()
    given.flags.writeable = False  # as those of the network, so nothing is compiled again
    return _select(given, limits, empty_keys(len(points)))


def _robot_corners(source: SourceSettings) -> tuple[Doubles, Doubles]:
    """Return the corners [3] of the robot, from where the source's rays begin."""
    low, high = np.array(source.robot_box_m or _NOWHERE) - source.ray_origin_m
    return low, high


def usable_rays(
    points: Floats,
    world_from_sensor: Doubles,
    settings: ScanSettings,
    *,
    source: SourceSettings = ANY_SOURCE,
    no_return: Floats | None = None,
    map_origin: Doubles | None = None,
) -> ScanRays:
    """Return the rays of a scan that are finite, in range and thinned, and those that met nothing.

    Args:
        points: end points [N, 3], metres, sensor frame.
        world_from_sensor: pose [4, 4].
        settings: thinning, and the ranges of the source.
        source: what else is particular to the source.
        no_return: directions [M, 3], sensor frame, of rays that met nothing.
        map_origin: [3] from where the map counts; ``None``: that of one whose first scan this is.

    Raises:
        ScanRefusedError: the pose or a direction is bad, or no ray can be used.
    """
    given = np.empty((0, 3), np.float32) if no_return is None else no_return
    _check_pose(world_from_sensor)
    origin = first_origin(world_from_sensor) if map_origin is None else map_origin
    pose = local_pose(world_from_sensor, origin)
    _check_shapes(points, given)
    directions = _unit_vectors(given) if source.no_return else np.empty((0, 3))
    pose = moved_pose(pose, pose[:3, :3] @ source.ray_origin_m)
    found = _selected(points, settings, source)
    disbelieved = len(given) - len(directions)
    rays = found.kept, found.beyond, settings.range_max_m * directions
    if (count := sum(map(len, rays))) == 0:
        raise ScanRefusedError("empty", _why_empty(len(points), disbelieved, settings, source))
    used = _thinned(rays, settings.max_points)
    ends, far_ends, open_ends = (some @ pose[:3, :3].T + pose[:3, 3] for some in used)
    return ScanRays(
        pose[:3, 3].copy(),
        ends,
        found.dropped(no_return=disbelieved, too_many=count - sum(map(len, used))),
        far_ends,
        open_ends,
        robot=None if source.robot_box_m is None else RobotBox(*_robot_corners(source), pose),
        map_origin=origin,
    )
