"""Scans from the network to rays: received, decoded, checked at the edge, thinned."""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import zenoh
from triquad_format.errors import FormatError, ProtocolVersionError, WireError
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.pose import is_rigid, rotation_error
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import Scan
from triquad_map.compiled.kernel import kernel
from triquad_map.compiled.voxel_index import empty_keys, enter

from triquad_server.errors import ScanRefusedError
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.net.requests import payload_limit
from triquad_server.settings import ScanSettings

_log = logging.getLogger(__name__)

WORLD_LIMIT_M = 100_000.0
"""A sensor farther than this from the map's origin is refused."""


class ScanIntake:
    """Receives scans from Zenoh, decodes them and puts them into the queue."""

    def __init__(
        self,
        session: zenoh.Session,
        map_name: str,
        queue: ScanQueue,
        *,
        max_points: int,
        arrived: Callable[[], None],
    ) -> None:
        """Begin to receive; ``arrived`` is called after each scan that was queued.

        Scans of more than ``max_points`` points are refused here, so that the queue, whose limit
        is a number of scans, is bounded in bytes too.
        """
        self._max_points = max_points
        self._queue = queue
        self._arrived = arrived
        # A ring, since a full channel of another kind would stall the network's threads.
        self._subscriber = session.declare_subscriber(
            keys.all_scans_key(map_name), zenoh.handlers.RingChannel(queue.limit)
        )
        self._thread = threading.Thread(target=self._run, name="scan-intake")
        self._thread.start()

    def close(self) -> None:
        """Take no more scans."""
        self._subscriber.undeclare()
        self._thread.join()

    def _run(self) -> None:
        for sample in self._subscriber:
            try:
                self._receive(str(sample.key_expr), sample.payload)
            except Exception:  # an internal error must not stop the intake of other scans
                self._queue.dropped.add("internal")
                _log.exception("a scan on %s could not be received", sample.key_expr)
            self._arrived()

    def _receive(self, key: str, payload: zenoh.ZBytes) -> None:
        max_bytes = payload_limit(self._max_points)
        if len(payload) > max_bytes:
            self._drop("too_large", key, f"{len(payload)} bytes exceed {max_bytes}")
            return
        try:
            scan = codec.decode(Scan, payload.to_bytes())
        except ProtocolVersionError as error:
            self._drop("bad_version", key, error)
        except WireError as error:
            self._drop("decode", key, error)
        else:
            self._enter(key, scan)

    def _enter(self, key: str, scan: Scan) -> None:
        """Put a decoded scan into the queue, where it may be there."""
        if key.rpartition("/")[2] != scan.source:
            self._drop("key_source_mismatch", key, f"its source is {scan.source!r:.80}")
            return
        try:
            keys.check_name("source", scan.source)
        except FormatError as error:
            self._drop("bad_source", key, error)
            return
        points = len(scan.points)
        if points > self._max_points:
            text = f"{points} points exceed the limit of {self._max_points}"
            self._queue.refuse(scan, "too_many_points", text)
            return
        self._queue.put(scan)

    def _drop(self, reason: str, key: str, cause: object) -> None:
        self._queue.dropped.add(reason)
        _log.debug("scan on %s dropped (%s): %s", key, reason, cause)


@dataclass(frozen=True)
class ScanRays:
    """The usable rays of a scan, in the map frame, metres."""

    origin: Doubles  # [3] the sensor
    ends: Doubles  # [N, 3]
    points_dropped: dict[str, int]  # points of the scan that are not used, by reason


def _check_pose(world_from_sensor: Doubles) -> None:
    """Refuse a pose [4, 4] that is not finite, not rigid or outside the world."""
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
    far = float(np.abs(pose[:3, 3]).max())
    if far > WORLD_LIMIT_M:
        raise ScanRefusedError(
            "outside_world",
            f"the sensor is {far:.0f} m from the map's origin, more than {WORLD_LIMIT_M:.0f} m; "
            "subtract an offset from the poses",
        )


def _check_points(points: Floats, max_points: int) -> None:
    """Refuse points that are not [N, 3], or more than ``max_points``."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise ScanRefusedError("points_shape", f"points are {list(points.shape)}, not [N, 3]")
    if len(points) > max_points:
        raise ScanRefusedError(
            "too_many_points", f"{len(points)} points exceed scan.max_points = {max_points}"
        )


@kernel()
def _select(
    points: Floats, range_min_m: float, range_max_m: float, thin_m: float, keys: Longs
) -> tuple[Doubles, int, int, int]:
    """The points that are used; how many are not finite, too near and too far."""
    kept = np.empty((len(points), 3))
    count = not_finite = too_near = too_far = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        distance = np.sqrt(x * x + y * y + z * z)
        if not np.isfinite(distance):
            not_finite += 1
        elif distance < range_min_m or distance == 0:  # which is "no return" to many sensors
            too_near += 1
        elif distance > range_max_m:
            too_far += 1
        elif enter(keys, x, y, z, thin_m):
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            count += 1
    return kept[:count], not_finite, too_near, too_far


def usable_rays(points: Floats, world_from_sensor: Doubles, settings: ScanSettings) -> ScanRays:
    """The rays of a scan that are finite, in range and thinned.

    Args:
        points: end points [N, 3], metres, sensor frame.
        world_from_sensor: pose [4, 4].
        settings: ranges and thinning.

    Raises:
        ScanRefusedError: the pose is bad, or no point can be used.
    """
    _check_pose(world_from_sensor)
    _check_points(points, settings.max_points)
    kept, not_finite, too_near, too_far = _select(
        np.ascontiguousarray(points),
        settings.range_min_m,
        settings.range_max_m,
        settings.thin_m,
        empty_keys(len(points)),
    )
    dropped = {"not_finite": not_finite, "too_near": too_near, "too_far": too_far}
    if len(kept) == 0:
        raise ScanRefusedError(
            "empty",
            f"none of {len(points)} points is finite and between {settings.range_min_m} m and "
            f"{settings.range_max_m} m from the sensor",
        )
    rotation, origin = world_from_sensor[:3, :3], world_from_sensor[:3, 3]
    counts = {reason: count for reason, count in dropped.items() if count}
    return ScanRays(origin.copy(), kept @ rotation.T + origin, counts)
