"""Keeps the scans that a map is learnt from, with its checkpoints, so that it can be learnt again.

Not all: of each source, one wherever it has moved on or turned, and now and then while it rests. Of
the others the pose is kept, so that corrections of poses at any time find what they correct.
"""

import logging
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from triquad_format.errors import FormatError
from triquad_format.mapfile.files import sync_folder
from triquad_format.mapfile.index import Restored
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import moved_pose
from triquad_format.scan_log.log_folder import LOG_NAME, of_map, segment_name, segments
from triquad_format.scan_log.ros_messages import Transform
from triquad_format.scan_log.segment import (
    Entry,
    LoggedCorrection,
    LoggedReset,
    LoggedScan,
    SegmentWriter,
    read_corrections,
)
from triquad_format.wire.messages import Scan

from triquad_server.intake.rays import ScanRays

_log = logging.getLogger(__name__)

_APART_VOXELS, _APART_DEG, _APART_S = 2.5, 10.0, 2.0
"""How far a source has moved, turned, or rested until its next scan is kept."""

_BEYOND = 1.01  # times the range of a source: where points beyond it are put

_UNFINISHED = ".unfinished-{}.mcap"


class ScanLog:
    """The log of one map. The mapper's thread adds and cuts; who writes checkpoints keeps."""

    def __init__(
        self, folder: Path, max_bytes: int, leaf_m: float, epoch: int, restored: Restored | None
    ) -> None:
        """Go on with the log in the map's folder, which is made where it is not there.

        Args:
            folder: of the map's checkpoints.
            max_bytes: that the files may have together; 0: nothing is kept, nor written.
            leaf_m: side of the map's voxels.
            epoch: of the checkpoint from which the map goes on; 0: it begins. What the map took in
                later than that it has lost, and so does the log.
            restored: when the map went back to an older checkpoint, the last time.
        """
        self.folder = folder / LOG_NAME
        self.error: str | None = None
        self.max_bytes = max_bytes
        self.apart_m = _APART_VOXELS * leaf_m
        self._kept: dict[str, Transform] = {}  # the last scan of each source that was kept
        self._followed: deque[Entry] | None = None
        self._writer: SegmentWriter | None = None
        self._opened = 0  # files
        self._lost = False  # what was added could not be written; of the mapper's thread
        self._newest: int | None = 0  # epoch with which the newest file ends; None: it was lost
        self.outdated: list[range] = []  # epochs whose checkpoints lack a correction of their scans
        if max_bytes > 0:
            self._go_on(epoch, restored)

    @property
    def is_kept(self) -> bool:
        """Return whether any scans are kept."""
        return self.max_bytes > 0

    def follow(self, followed: "deque[Entry] | None") -> None:
        """Add to a queue, too, what is added from now on; ``None``: to none any more.

        Meanwhile all files stay: who follows reads them.
        """
        self._followed = followed

    def add(self, scan: Scan, rays: ScanRays) -> None:
        """Keep a scan that was taken in; its pose, if its source has not moved on since another.

        Both count from the map's origin.
        """
        if not self.is_kept:
            return
        pose = moved_pose(scan.world_from_sensor, rays.map_origin)
        transform = Transform(scan.stamp_ns, scan.source, pose)
        if not self._is_apart(transform):
            self._put(transform, lambda writer: writer.add_pose(transform))
            return
        rotation, position = scan.world_from_sensor[:3, :3], scan.world_from_sensor[:3, 3]
        beyond = rays.origin + _BEYOND * (rays.far_ends - rays.origin)
        points = (np.concatenate([rays.ends, beyond]) - position) @ rotation
        no_return = (rays.open_ends - rays.origin) @ rotation
        lengths = np.linalg.norm(no_return, axis=1, keepdims=True)
        logged = LoggedScan(
            scan.source,
            scan.stamp_ns,
            pose,
            points.astype(np.float32),
            (no_return / np.maximum(lengths, 1e-9)).astype(np.float32),
        )
        self._kept[scan.source] = transform
        self._put(logged, lambda writer: writer.add(logged))

    def add_reset(self, minimum: Doubles, maximum: Doubles) -> None:
        """Keep that the map forgot what lies between two corners [3] of the user's coordinates."""
        if not self.is_kept:
            return
        self._kept.clear()
        reset = LoggedReset(minimum, maximum)
        self._put(reset, lambda writer: writer.add_reset(reset, time.time_ns()))

    def add_correction(self, correction: LoggedCorrection) -> None:
        """Keep that poses of scans before were corrected."""
        self._kept.pop(correction.source, None)
        self._put(correction, lambda writer: writer.add_correction(correction))

    def cut(self) -> SegmentWriter | None:
        """Return the file with what was added since the last time; ``None``: none can be."""
        if self.is_kept:
            with self._telling("cannot be written"):
                self._open()
        return self._taken()

    def keep(self, written: SegmentWriter | None, epoch: int) -> None:
        """Make a file durable that ends with ``epoch``; the oldest go that there is no room for.

        An empty one tells that the log goes on until then.
        """
        if written is None:
            return
        if not written.messages and epoch == self._newest:
            written.discard()
            return
        after = epoch if written.after_loss or self._newest is None else self._newest
        self._newest = None
        with self._telling("cannot be written", written):
            written.finish()
            with written.path.open("rb") as stream:
                os.fsync(stream.fileno())
            os.replace(written.path, self.folder / segment_name(after, epoch))
            sync_folder(self.folder)
            self._newest = epoch
            self._outdate(written.corrections, epoch)
            if self._followed is None:
                self._make_room()

    def close(self) -> None:
        """Give up what was added since the last time, for the map has it in no checkpoint."""
        if (written := self._taken()) is not None:
            written.discard()

    def _outdate(self, corrections: list[LoggedCorrection], epoch: int) -> None:
        self.outdated += [range(one.first_epoch, epoch) for one in corrections]

    def _go_on(self, epoch: int, restored: Restored | None) -> None:
        """Go on with the files that are there, up to a checkpoint's epoch."""
        with self._telling("cannot be opened"):
            self.folder.mkdir(exist_ok=True)
            found = segments(self.folder)
            for path in self.folder.glob(_UNFINISHED.format("*")):
                path.unlink()
            for segment in found:
                if segment.epoch > epoch:
                    segment.path.unlink()
                    continue
                with suppress(FormatError):  # who corrects poses is told of it
                    self._outdate(read_corrections(segment.path), segment.epoch)
            newest = max((one.epoch for one in of_map(found, epoch, restored)), default=0)
            # Each checkpoint has its file: else what came before it was lost, or not kept.
            goes_on = newest == epoch
            if restored is not None and restored.as_epoch == epoch > newest:
                goes_on = newest == restored.epoch
            self._newest = newest if goes_on else None
            if newest < epoch:
                # An empty file marks that what came since is lost, or in the map no more.
                self.keep(self.cut(), epoch)

    def _taken(self) -> SegmentWriter | None:
        written, self._writer = self._writer, None
        return written

    def _is_apart(self, taken: Transform) -> bool:
        kept = self._kept.get(taken.child)
        if kept is None or taken.stamp_ns - kept.stamp_ns >= _APART_S * 1e9:
            return True
        moved = np.linalg.inv(kept.pose) @ taken.pose
        turned = math.degrees(math.acos(min(1.0, max(-1.0, (np.trace(moved[:3, :3]) - 1) / 2))))
        return float(np.linalg.norm(moved[:3, 3])) >= self.apart_m or turned >= _APART_DEG

    def _open(self) -> SegmentWriter:
        if self._writer is None:
            self._opened += 1
            path = self.folder / _UNFINISHED.format(self._opened)
            self._writer = SegmentWriter(path, after_loss=self._lost)
            self._lost = False
        return self._writer

    def _put(self, entry: Entry, add: Callable[[SegmentWriter], None]) -> None:
        """Add an entry to the file; where that fails, it is lost, and what was added before."""
        if self._followed is not None:
            self._followed.append(entry)
        with self._telling("cannot be written"):
            try:
                add(self._open())
            except OSError:
                self._lost = True
                self._kept.clear()
                self.close()
                raise

    def _make_room(self) -> None:
        """Delete the oldest files while all take more than they may."""
        files = [(one, one.path.stat().st_size) for one in segments(self.folder)]
        total = sum(size for _, size in files)
        for segment, size in files[:-1]:
            if total <= self.max_bytes:
                return
            segment.path.unlink()
            total -= size
            # No checkpoint before its end serves any more.
            self.outdated = [one for one in self.outdated if one.stop > segment.epoch]

    @contextmanager
    def _telling(self, what: str, written: SegmentWriter | None = None) -> Iterator[None]:
        """Do something to the files; where that fails, mapping goes on, and the error is told.

        A file that is being ``written`` is deleted then.
        """
        try:
            yield
            self.error = None
        except OSError as error:
            if written is not None:
                written.discard()
            if self.error is None:
                _log.error("the scan log in %s %s: %s", self.folder, what, error)
            self.error = f"the scan log {what}: {error}"
