"""The origin of a map: the place in its user's coordinates from which the map itself counts.

The map computes in single precision around it. Coordinates such as UTM's are too large for that.
"""

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import moved_pose
from triquad_format.wire.limits import MAX_POSITION_M

from triquad_server.errors import ScanRefusedError

FAR_M = 10_000.0
"""A map whose first scan was taken farther away than this has an origin near there."""

_STEP_M = 100.0  # of an origin: whole metres, which doubles represent exactly and people can read

_DECIMALS = 6  # of positions from an origin, metres: a drive gives the same map wherever it is

WORLD_LIMIT_M = 100_000.0
"""A sensor farther than this from the map's origin is refused."""


def first_origin(world_from_sensor: Doubles) -> Doubles:
    """Return the origin [3] of a map whose first scan has this pose [4, 4], 0 0 0 if it is near."""
    position = world_from_sensor[:3, 3]
    is_far = FAR_M < np.abs(position).max() <= MAX_POSITION_M
    return np.round(position / _STEP_M) * _STEP_M if is_far else np.zeros(3)


def local_pose(world_from_sensor: Doubles, origin: Doubles) -> Doubles:
    """Return a pose [4, 4] from the map's origin [3].

    Raises:
        ScanRefusedError: ``outside_world``: it is too far from there.
    """
    local = moved_pose(world_from_sensor, -origin)
    if origin.any():  # as it was given: in coordinates of UTM the last digits are of nanometres
        local[:3, 3] = local[:3, 3].round(_DECIMALS)
    far = float(np.abs(local[:3, 3]).max())
    if far > WORLD_LIMIT_M:
        x, y, z = origin.tolist()
        raise ScanRefusedError(
            "outside_world",
            f"the sensor is at {world_from_sensor[:3, 3].tolist()} m, {far:.0f} m from the map's "
            f"origin {x:.12g} {y:.12g} {z:.12g}, which the first scan of the map chose, and more "
            f"than {WORLD_LIMIT_M:.0f} m: poses that begin in one frame and go on in another, as "
            "where a first GPS fix comes late, are of two maps",
        )
    return local
