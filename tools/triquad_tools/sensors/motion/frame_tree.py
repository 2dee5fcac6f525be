"""The tree of frames that robots report: how frames stand or move in each other over time."""

from array import array
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from triquad_client.pose import Pose, pose_matrices
from triquad_format.records.arrays import Doubles, Longs

from triquad_tools.sensors.sweep import NoTransformError

MAX_GAP_S = 2.0
"""Nothing is interpolated between poses that lie farther apart."""

_WIDTH = 7  # numbers of a pose
_NEARLY_PARALLEL = 0.9995  # quaternions, of which spherical interpolation would divide by nearly 0

STATIC = None
"""The stamp of a transform that always holds."""

ROOT_NAMES = ("map", "odom", "world")
"""Frames that stand still, as usual in ROS (REP 105), in order of preference."""


class Track:
    """The poses of a frame in its parent, in the order of their stamps.

    Positions are interpolated on straight lines and rotations on great circles (Shoemake 1985).
    Nothing is extrapolated.
    """

    def __init__(self, limit: int | None = None) -> None:
        """Only the ``limit`` newest poses are kept."""
        self._limit = limit
        self._stamps = array("q")
        self._values = array("d")  # position and unit quaternion of each

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first stamp and the last, of a track that has poses."""
        return self._stamps[0], self._stamps[-1]

    def add(self, stamp_ns: int, position_m: Doubles, quaternion: Doubles) -> None:
        """Add a pose, position [3] and unit quaternion [4]; one with the same stamp is replaced."""
        at = bisect_left(self._stamps, stamp_ns)
        replaced = at < len(self._stamps) and self._stamps[at] == stamp_ns
        if not replaced:
            self._stamps.insert(at, stamp_ns)
        end = at + 1 if replaced else at
        self._values[_WIDTH * at : _WIDTH * end] = array("d", [*position_m, *quaternion])
        if self._limit is not None and len(self._stamps) > self._limit:
            del self._stamps[0], self._values[:_WIDTH]

    def poses(self, stamps_ns: Longs) -> Doubles:
        """Return poses [M, 4, 4] at times [M].

        Raises:
            NoTransformError: a time lies before the first pose, after the last, or in a gap.
        """
        self._check_covered(stamps_ns)
        stamps, values = self._around(int(stamps_ns.min()), int(stamps_ns.max()))
        after = np.clip(np.searchsorted(stamps, stamps_ns), 1, len(stamps) - 1)
        if len(stamps) == 1:
            after = np.zeros_like(after)
        before = np.maximum(after - 1, 0)
        self._check_gaps(stamps_ns, stamps[before], stamps[after])
        span = np.maximum(stamps[after] - stamps[before], 1)
        share = ((stamps_ns - stamps[before]) / span)[:, None]
        first, second = values[before], values[after]
        positions = first[:, :3] + share * (second[:, :3] - first[:, :3])
        return pose_matrices(positions, _slerp(first[:, 3:], second[:, 3:], share))

    def _around(self, first_ns: int, last_ns: int) -> tuple[Longs, Doubles]:
        """Return stamps [K] and values [K, 7] of the poses between two times, and around them."""
        low = max(0, bisect_left(self._stamps, first_ns) - 1)
        high = bisect_left(self._stamps, last_ns) + 1
        values = np.array(self._values[_WIDTH * low : _WIDTH * high], np.float64)
        return np.array(self._stamps[low:high], np.int64), values.reshape(-1, _WIDTH)

    def _check_covered(self, stamps_ns: Longs) -> None:
        if not self._stamps:
            raise NoTransformError("no_poses", "there are no poses", late=True)
        first, last = self.span_ns
        if stamps_ns.max() > last:
            late_s = (int(stamps_ns.max()) - last) / 1e9
            raise NoTransformError("pose_late", f"{late_s:.3g} s after the last pose", late=True)
        if stamps_ns.min() < first:
            early_s = (first - int(stamps_ns.min())) / 1e9
            raise NoTransformError("pose_early", f"{early_s:.3g} s before the first pose")

    @staticmethod
    def _check_gaps(stamps_ns: Longs, before: Longs, after: Longs) -> None:
        between = (stamps_ns != before) & (stamps_ns != after)
        gaps_s = np.where(between, after - before, 0) / 1e9
        if gaps_s.max() > MAX_GAP_S:
            raise NoTransformError(
                "pose_gap", f"between two poses {gaps_s.max():.3g} s apart (at most {MAX_GAP_S:g})"
            )


def _slerp(first: Doubles, second: Doubles, share: Doubles) -> Doubles:
    """Interpolate between unit quaternions [M, 4], by the shorter way."""
    cosine = (first * second).sum(axis=1, keepdims=True)
    second = np.where(cosine < 0, -second, second)
    cosine = np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, _NEARLY_PARALLEL))
    of_first = np.where(cosine < _NEARLY_PARALLEL, np.sin((1 - share) * angle), 1 - share)
    of_second = np.where(cosine < _NEARLY_PARALLEL, np.sin(share * angle), share)
    between = of_first * first + of_second * second
    turned: Doubles = between / np.linalg.norm(between, axis=1, keepdims=True)
    return turned


@dataclass(frozen=True)
class Transform:
    """The pose of a frame in its parent."""

    parent: str
    child: str
    stamp_ns: int | None  # nanoseconds since 1970, or STATIC
    pose: Pose


@dataclass
class _Edge:
    """The edge from a frame to its parent."""

    parent: str
    standing: Doubles | None  # [4, 4] where it always holds
    track: Track


class FrameTree:
    """Transforms over time, and the poses of a frame in another.

    As in tf2 a frame has one parent: a transform to another one replaces what was known of it.
    """

    def __init__(self, limit: int | None = None) -> None:
        """Only the ``limit`` newest poses of each frame are kept."""
        self._limit = limit
        self._edges: dict[str, _Edge] = {}

    @property
    def frames(self) -> list[str]:
        """The names of all frames."""
        return sorted({*self._edges, *(edge.parent for edge in self._edges.values())})

    @property
    def moving(self) -> list[str]:
        """The names of the frames of which it was reported that they move in their parent."""
        return sorted(name for name, edge in self._edges.items() if edge.standing is None)

    def add(self, transform: Transform) -> None:
        """Add a transform.

        Raises:
            InvalidScanError: its pose is none.
        """
        if transform.child == transform.parent:
            return
        position, quaternion = transform.pose.numbers()
        edge = self._edges.get(transform.child)
        if edge is None or edge.parent != transform.parent:
            edge = _Edge(transform.parent, None, Track(self._limit))
            self._edges[transform.child] = edge
        if transform.stamp_ns is STATIC:
            edge.standing = pose_matrices(position, quaternion)
        else:
            edge.standing = None
            edge.track.add(transform.stamp_ns, position, quaternion)

    def with_track(self, parent: str, child: str, track: Track) -> "FrameTree":
        """Return a tree that differs in where ``child`` is, and else shares what this one knows."""
        tree = FrameTree(self._limit)
        tree._edges = {**self._edges, child: _Edge(parent, None, track)}
        return tree

    def newest_ns(self, child: str) -> int | None:
        """Return the stamp of the newest pose of a frame that moves in its parent."""
        edge = self._edges.get(child)
        is_moving = edge is not None and edge.standing is None and len(edge.track) > 0
        return edge.track.span_ns[1] if edge is not None and is_moving else None

    def knows(self, child: str) -> bool:
        """Return whether a transform says where a frame is."""
        return child in self._edges

    def __len__(self) -> int:
        """Return the number of frames that have a transform."""
        return len(self._edges)

    def forget(self, child: str) -> None:
        """Remove the transforms of a frame."""
        self._edges.pop(child, None)

    def root(self, frame: str) -> str:
        """Return the topmost ancestor of ``frame``; itself if it has no parent."""
        return self._path(frame)[-1]

    def fixed_frame(self, frame: str) -> str:
        """Return the frame to map in: of those above ``frame`` a usual one, or else the root."""
        path = self._path(frame)
        return next((name for name in ROOT_NAMES if name in path), path[-1])

    def poses(self, target: str, frame: str, stamps_ns: Longs) -> Doubles:
        """Return poses [M, 4, 4] ``target_from_frame`` at times [M].

        Raises:
            NoTransformError: the frames do not hang together, or not at those times.
        """
        up, down = self._path(frame), self._path(target)
        shared = next((name for name in up if name in down), None)
        if shared is None:
            raise self._unconnected(target, frame)
        shared_from_frame = self._climb(up[: up.index(shared)], stamps_ns)
        shared_from_target = self._climb(down[: down.index(shared)], stamps_ns)
        target_from_frame: Doubles = np.linalg.inv(shared_from_target) @ shared_from_frame
        return target_from_frame

    def moves(self, target: str, frame: str) -> bool:
        """Return whether it was ever reported that ``frame`` moves in ``target``."""
        up, down = self._path(frame), self._path(target)
        between = {*up} ^ {*down}
        return any(name in self._edges and self._edges[name].standing is None for name in between)

    def _path(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on up to the root."""
        path = [frame]
        while (edge := self._edges.get(path[-1])) is not None and edge.parent not in path:
            path.append(edge.parent)
        return path

    def _climb(self, path: list[str], stamps_ns: Longs) -> Doubles:
        """Return poses of the first frame of a path in the parent of the last."""
        poses = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
        for child in path:
            edge = self._edges[child]
            if edge.standing is not None:
                poses = edge.standing @ poses
                continue
            try:
                poses = edge.track.poses(stamps_ns) @ poses
            except NoTransformError as error:
                text = f"{edge.parent} from {child}: {error}"
                raise NoTransformError(error.reason, text, late=error.late) from None
        return np.array(poses)

    def _unconnected(self, target: str, frame: str) -> NoTransformError:
        if frame not in self.frames:
            known = ", ".join(self.frames[:10]) or "none"
            text = f"no transform names the frame {frame!r} (known: {known})"
        elif target not in self.frames:
            text = f"no transform names the map frame {target!r}: {frame} is in {self.root(frame)}"
        else:
            text = (
                f"{frame} is in {self.root(frame)} and {target} in {self.root(target)}, and no "
                "transform connects the two"
            )
        return NoTransformError("no_transform", text, late=True)
