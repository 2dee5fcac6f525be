"""Better poses for scans that are in the map."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.printable import printable
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.pose import quaternion_of
from triquad_format.wire.limits import MAX_KEYFRAMES
from triquad_format.wire.source_messages import CorrectPosesReply, CorrectPosesRequest

from triquad_client import checks
from triquad_client.calls.scans import ScanCalls
from triquad_client.checks import real_numbers
from triquad_client.errors import NO_NUMBER, InvalidScanError
from triquad_client.net.connection import new_ticket
from triquad_client.pose import PoseLike, rigid_pose


class CorrectionCalls(ScanCalls):
    """Corrects the poses of scans."""

    def correct_poses(
        self,
        source: str,
        stamps_s: ArrayLike,
        world_from_sensor: ArrayLike | Sequence[PoseLike],
        *,
        onward: bool = False,
        timeout_s: float = 600.0,
    ) -> CorrectPosesReply:
        """Have the map be as better poses of a source's scans would have made it.

        The server makes it again from the scans that it keeps (``store.log_max_bytes``), and goes
        on with the map of before meanwhile. A scan between two of the poses moves, in its own
        frame, by what lies between their moves. First all that was published is dealt with.

        Args:
            source: whose scans they are; those of others stay where they are.
            stamps_s: [K] rising, seconds since 1970: those of scans, or between them.
            world_from_sensor: [K, 4, 4] or a list of :class:`Pose`, the poses at these times.
            onward: scans after the last of the poses, published before this call, move as that, as
                when a SLAM corrects where the robot is; else those before and after stay.
            timeout_s: how long to wait for that, at most.

        Returns:
            ``epoch``: the first of the corrected map. ``scans_moved``: scans whose pose changed.
            ``scans_learnt``: those of which regions were made again. ``kept_epoch`` and ``undo``:
            as of :meth:`reset`.

        Raises:
            InvalidScanError: the times do not rise, or a pose is none.
            RefusedError: ``bad_request``, where no scan of the source is kept, or points fit each
                other clearly better by another reading; ``store``, where what is needed is not
                kept. The map stays as it is.
            RequestTimeoutError: not done after ``timeout_s``; the server goes on with it, unless it
                had not come to all scans before.
        """
        stamps_ns, poses = _keyframes(stamps_s, world_from_sensor)
        deadline_s = checks.deadline(timeout_s)
        self.flush(timeout_s)
        quaternions = np.array([quaternion_of(pose[:3, :3]) for pose in poses])
        request = CorrectPosesRequest(
            source, stamps_ns, poses[:, :3, 3], quaternions, onward, new_ticket()
        )
        reply = self._connection.ask_until_done(request, deadline_s - time.monotonic())
        return reply if reply.undo is None else replace(reply, undo=printable(reply.undo))


def _keyframes(stamps_s: ArrayLike, poses: ArrayLike | Sequence[PoseLike]) -> tuple[Longs, Doubles]:
    """Return times [K] in nanoseconds since 1970, and poses [K, 4, 4] at them."""
    try:
        times = real_numbers(stamps_s).ravel().tolist()
    except NO_NUMBER as error:
        raise InvalidScanError(f"stamps_s are no times in seconds since 1970: {error}") from error
    stamps_ns = np.array([checks.stamp_ns(time_s) for time_s in times], np.int64)
    try:
        matrices = [rigid_pose(pose) for pose in cast("Sequence[PoseLike]", poses)]
    except TypeError as error:
        raise InvalidScanError(f"the poses are no list of matrices [4, 4]: {error}") from error
    if len(stamps_ns) != len(matrices) or not 0 < len(matrices) <= MAX_KEYFRAMES:
        raise InvalidScanError(
            f"{len(stamps_ns)} stamps_s and {len(matrices)} poses: as many of both, 1 to "
            f"{MAX_KEYFRAMES}, make a correction"
        )
    falls = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(falls):
        at = int(falls[0]) + 1
        raise InvalidScanError(
            f"stamps_s[{at}] = {int(stamps_ns[at]) / 1e9} is not later than the one before: "
            "they rise"
        )
    return stamps_ns, np.array(matrices)
