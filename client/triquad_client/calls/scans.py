"""Publishing scans, and waiting until they are in the map."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.errors import FormatError
from triquad_format.printable import printable
from triquad_format.records.arrays import Doubles, Floats
from triquad_format.wire import keys
from triquad_format.wire.bounds import MAX_COUNT
from triquad_format.wire.messages import FlushReply, FlushRequest, Scan
from triquad_format.wire.status_messages import ServerStatus, StatusRequest

from triquad_client import checks
from triquad_client.depth_image import Intrinsics, depth_points
from triquad_client.errors import InvalidScanError, RequestTimeoutError
from triquad_client.net.connection import Connection
from triquad_client.pose import PoseLike, rigid_pose

_log = logging.getLogger("triquad_client")

_FLUSH_PAUSES_S = 0.01, 0.1
"""The pause until a server is asked again whether scans are in the map: it doubles, up to this."""

_SETTLE_FLUSH_S = 5.0
_SETTLE_PAUSE_S = 0.2


@dataclass(frozen=True)
class FlushReport:
    """The outcome of the scans that this client published."""

    taken: int  # learnt from
    refused: int  # seen by the server, but of no use
    lost: int  # never arrived, or pushed out of the server's full queue
    last_refusal: str | None  # by source, why the last of the refused ones was
    warnings: tuple[str, ...] = ()  # what goes wrong with the scans, and which setting helps


@dataclass
class _Source:
    """The progress of a source."""

    session: int = field(default_factory=lambda: secrets.randbits(62))
    sequence: int = 0  # of the next scan
    stamp_ns: int = 0


class ScanCalls:
    """The calls that publish scans, and that wait until they are in the map."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._lock = threading.Lock()  # of the dictionary, never locked for long
        self._sources: dict[str, _Source] = {}
        self._warned: set[str] = set()  # what was logged

    def publish_scan(
        self,
        points: ArrayLike,
        world_from_sensor: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        no_return: ArrayLike | None = None,
    ) -> None:
        """Send a scan to be learnt. Returns once it is handed to the network.

        Args:
            points: [N, 3] metres, sensor frame; points that are not finite are left out, and so
                are up to 13 more columns, such as intensities.
            world_from_sensor: rigid pose of the sensor in the map frame: [4, 4], or a
                :class:`Pose` of position and quaternion.
            stamp_s: seconds since 1970, never running backwards within a source; ``None``: now.
            source: name of the sensor.
            no_return: directions [M, 3], sensor frame, of any length but 0, of rays that met
                nothing within the sensor's range: the space along them is free. A ray of which
                this is not known does not belong here; see docs/client.md. ``points`` may be
                empty where there are any.

        Raises:
            InvalidScanError: the scan cannot be used; nothing was sent.
        """
        pose = rigid_pose(world_from_sensor)
        directions = None if no_return is None else checks.open_directions(no_return)
        # Rays that all met nothing are a scan, too.
        least = 1 if directions is None or len(directions) == 0 else 0
        cloud = np.ascontiguousarray(checks.scan_points(points, least=least))
        stamp_ns = None if stamp_s is None else checks.stamp_ns(stamp_s)
        self._publish(source, cloud, pose, stamp_ns=stamp_ns, no_return=directions)

    def publish_depth(
        self,
        depth: ArrayLike,
        intrinsics: Intrinsics | ArrayLike,
        world_from_camera: PoseLike,
        stamp_s: float | None = None,
        source: str = "default",
        stride: int = 1,
        units_per_metre: float | None = None,
    ) -> None:
        """Send a depth image to be learnt. Returns once it is handed to the network.

        Servers ignore what is nearer than 1.5 m unless set otherwise: see ``range_min_m`` in
        docs/settings.md, which each source can have for itself.

        Args:
            depth: [rows, columns] along the optical axis: metres as floating numbers, or
                millimetres as ``uint16``. A pixel that is 0 or not finite shows nothing.
            intrinsics: of the camera, or its matrix [3, 3], such as OpenCV's ``K``; the image must
                be rectified.
            world_from_camera: pose of the camera's optical frame (x to the right, y down, z
                forward) in the map frame, as in :meth:`publish_scan`.
            stamp_s: as in :meth:`publish_scan`.
            source: name of the camera.
            stride: every how many rows and columns one is taken, where an image has more pixels
                than a scan may have points.
            units_per_metre: of the depths, where these are no metres or millimetres.

        Raises:
            InvalidScanError: the image cannot be used; nothing was sent.
        """
        points = depth_points(depth, intrinsics, stride, units_per_metre)
        self.publish_scan(points, world_from_camera, stamp_s, source)

    def restart_source(self, source: str = "default") -> None:
        """Let the time of a source begin again, as that of a simulation that was started again.

        Its next scan may have any stamp. :meth:`flush` counts only those from then on.
        """
        with self._sending, self._lock:
            self._sources.pop(source, None)

    def flush(self, timeout_s: float = 30.0, pending: int = 0) -> FlushReport:
        """Wait until what this client published is dealt with and queries see it.

        Args:
            timeout_s: how long, at most.
            pending: number of scans that may still be under way: more than 0 lets a fast
                publisher run ahead of the server by as many.

        Returns:
            What became of the scans so far.

        Raises:
            RequestTimeoutError: that was not long enough; the text says what is known by then.
        """
        wait_s = checks.within("timeout_s", timeout_s, checks.LONGEST_S, least=0.0)
        ahead = checks.count("pending", pending, MAX_COUNT)
        done = self._all_done(list(self._requests(ahead)), wait_s)
        replies = done.values()
        refusals = [
            f"source {source!r}: {reply.last_refusal}"
            for source, reply in done.items()
            if reply.last_refusal is not None
        ]
        warnings = tuple(line for reply in replies for line in reply.warnings)
        self._log_new(warnings)
        return FlushReport(
            taken=sum(reply.taken for reply in replies),
            refused=sum(reply.refused for reply in replies),
            lost=sum(reply.lost for reply in replies),
            last_refusal="; ".join(refusals) or None,
            warnings=warnings,
        )

    def settle(self, timeout_s: float = 600.0) -> ServerStatus:
        """Wait until what this client published is dealt with and nothing is left to learn.

        Raises:
            RequestTimeoutError: it still had some after ``timeout_s``.
        """
        deadline = checks.deadline(timeout_s)
        # A status that overtakes the last scan would say that there is nothing left to learn.
        while not self._dealt_with_by(deadline):
            _check_time(deadline, timeout_s)
        while not (now := self._connection.ask(StatusRequest())).settled:
            _check_time(deadline, timeout_s)
            time.sleep(_SETTLE_PAUSE_S)
        return now

    def _publish(
        self,
        source: str,
        points: Floats,
        pose: Doubles,
        *,
        stamp_ns: int | None,
        no_return: Floats | None,
    ) -> None:
        try:
            key = keys.scan_key(self._connection.map_name, source)
        except FormatError as error:
            raise InvalidScanError(str(error)) from error
        # Locked while sending: the server takes a scan that is overtaken by its successor for lost.
        with self._sending:
            with self._lock:
                state = self._sources.setdefault(source, _Source())
            if stamp_ns is None:  # never backwards, also where the system's clock was set back
                stamp_ns = max(time.time_ns(), state.stamp_ns)
            if stamp_ns < state.stamp_ns:
                raise InvalidScanError(
                    f"stamp_s = {stamp_ns / 1e9!r} lies before {state.stamp_ns / 1e9!r}, that of "
                    f"an earlier scan of source {source!r}; publish in order"
                )
            session, sequence, local = state.session, state.sequence, self._connection.local
            scan = Scan(points, pose, stamp_ns, source, session, sequence, no_return, local)
            self._connection.put(key, scan)
            state.sequence += 1
            state.stamp_ns = stamp_ns

    def _log_new(self, warnings: tuple[str, ...]) -> None:
        """Log each warning once; the server says it in other words where it says it again."""
        with self._lock:
            new = [text for text in warnings if text not in self._warned]
            self._warned.update(new)
        for text in new:
            _log.warning("%s", printable(text))

    def _dealt_with_by(self, deadline: float) -> bool:
        """Return whether the scans are, after some waiting."""
        wait_s = min(max(deadline - time.monotonic(), 0.0), _SETTLE_FLUSH_S)
        try:
            self.flush(wait_s)
        except RequestTimeoutError:
            return False
        return True

    def _all_done(self, requests: list[FlushRequest], timeout_s: float) -> dict[str, FlushReply]:
        """Return the last reply about each source, once all their scans are dealt with.

        Raises:
            RequestTimeoutError: some are not, after ``timeout_s``.
        """
        started = time.monotonic()
        pause_s, longest_s = _FLUSH_PAUSES_S
        known: dict[str, FlushReply] = {}
        while True:
            waited_s = time.monotonic() - started
            asked = (replace(request, waited_s=waited_s) for request in requests)
            replies = list(self._connection.replies(asked))
            known.update((one.source, reply) for one, reply in zip(requests, replies, strict=True))
            requests = [request for request in requests if not known[request.source].done]
            if not requests:
                return known
            if waited_s >= timeout_s:
                first, so_far = requests[0], known.values()
                raise RequestTimeoutError(
                    f"scan {first.sequence} of source {first.source!r} is not in the map after "
                    f"{timeout_s:g} s; so far {sum(one.taken for one in so_far)} scans were taken, "
                    f"{sum(one.refused for one in so_far)} refused, "
                    f"{sum(one.lost for one in so_far)} lost"
                )
            time.sleep(min(pause_s, max(0.0, timeout_s - waited_s)))
            pause_s = min(2 * pause_s, longest_s)

    def _requests(self, pending: int) -> Iterator[FlushRequest]:
        """Yield one request per source; the scans that may be pending are shared out among them."""
        with self._lock:
            states = dict(self._sources)
        for source, state in states.items():
            target = state.sequence - 1 - pending // len(states)
            if target >= 0:
                yield FlushRequest(
                    source=source,
                    session=state.session,
                    sequence=target,
                    waited_s=0.0,
                )


def _check_time(deadline: float, timeout_s: float) -> None:
    if time.monotonic() > deadline:
        raise RequestTimeoutError(f"the server still learns after {timeout_s:g} s")
