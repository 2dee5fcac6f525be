"""The tree of frames that robots report: how frames stand or move in each other."""

from dataclasses import dataclass

import numpy as np
from triquad_client.pose import Pose, pose_matrices
from triquad_format.records.arrays import Doubles, Longs

from triquad_tools.sensors.motion.track import Track
from triquad_tools.sensors.sweep import NoTransformError

STATIC = None
"""The stamp of a transform that always holds."""

ROOT_NAMES = ("map", "odom", "world")
"""Frames that stand still, as usual in ROS (REP 105), in order of preference."""


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
