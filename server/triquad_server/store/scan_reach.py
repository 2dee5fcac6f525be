"""The regions that scans of a log enter, or would enter with other poses."""

import itertools

import numpy as np
from triquad_format.records.field_settings import RegionIndex
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import LoggedScan
from triquad_format.scan_log.tracks import source_of

from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.region_reach import regions_between
from triquad_server.settings import ANY_SOURCE

_BEYOND = 1.05  # times the range of a source: points beyond it are kept a little farther away
_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
_AXES = np.arange(3)


class ScanReach:
    """Tells which regions of a map scans enter; some that they only might, too."""

    def __init__(self, mapper: Mapper) -> None:
        """Tell it of a live map, which has its origin."""
        self._settings, self._field = mapper.settings, mapper.regions.field
        self._origin = mapper.origin

    def of(self, entry: LoggedScan | Transform) -> frozenset[RegionIndex]:
        """Return the regions that meet the box of a scan.

        Of one of which only the pose was kept it is a cube as far around as its source sees.
        """
        source = self._settings.sources.get(source_of(entry), ANY_SOURCE)
        range_m = _BEYOND * self._settings.scan_of(source).range_max_m
        sensor, robot = np.array([source.ray_origin_m]), source.robot_box_m
        parts = [sensor, np.zeros((0, 3)) if robot is None else np.array(robot)[_CORNERS, _AXES]]
        if isinstance(entry, Transform):
            pose = entry.pose
            parts.append(sensor + range_m * (2 * _CORNERS - 1))
        else:
            pose = entry.world_from_sensor
            parts += [entry.points, sensor + range_m * entry.no_return]
        points = np.concatenate(parts) @ pose[:3, :3].T + pose[:3, 3] - self._origin
        around = regions_between(points, self._field, self._field.leaf_m)  # the log rounds points
        return frozenset(itertools.product(*around))
