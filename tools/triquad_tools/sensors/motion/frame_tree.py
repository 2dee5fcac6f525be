"""The tree of frames that robots report: how frames stand or move in each other over time."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from triquad_client.pose import Pose
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.pose import pose_matrices

from triquad_tools.sensors.motion.track import MAX_GAP_S, Track
from triquad_tools.sensors.sweep import NoTransformError

STATIC = None  # the stamp of a transform that always holds
_RIVAL_NS = 10 * 10**9  # after which a parent counts no more, of which nothing was heard since
_NEARLY_UNIT = 1e-6  # the length of a quaternion that is left as it is
_MAX_PARENTS = 8  # of a frame, whose names come from the network

_TWO_PUBLISHERS = (
    "{} from {} jumps to and fro, {} times, by {:.2g} m: two programs publish it; choose the topic "
    "of one, or other poses, by --poses"
)
_CORRECTION = (
    "{} from {} comes up to {:.1f} s apart: where it moved by no more than drift does, it is taken "
    "to move evenly between, else to stay as it was until the next"
)

ROOT_NAMES = ("map", "odom", "world")  # stand still (REP 105), in order of preference


@dataclass(frozen=True)
class Transform:
    """The pose of a frame in its parent."""

    parent: str
    child: str
    stamp_ns: int | None  # nanoseconds since 1970, or STATIC
    pose: Pose

    def numbers(self) -> tuple[Sequence[float], Sequence[float]]:
        """Return the position [3] and the unit quaternion [4].

        Raises:
            InvalidScanError: its pose is none.
        """
        position, turn = self.pose.position_m, self.pose.quaternion_xyzw
        if (
            isinstance(position, tuple)  # as transforms come, a thousand a second
            and isinstance(turn, tuple)
            and abs(math.hypot(*turn) - 1) < _NEARLY_UNIT
            and math.isfinite(sum(position))
        ):
            return position, turn
        checked = self.pose.numbers()
        return checked[0].tolist(), checked[1].tolist()


@dataclass
class _Edge:
    parent: str
    standing: Doubles | None  # [4, 4] where it always holds
    track: Track
    count: int = 0  # of transforms
    problem: str | None = None  # "" where its poses were checked and are those of one publisher


class FrameTree:
    """Transforms over time, and the poses of a frame in another.

    A frame has one parent. Where transforms name several, ``wanted`` may decide, which is one of
    them or a frame above one; else a pose that depends on it is refused.
    """

    def __init__(self, limit: int | None = None, wanted: str = "") -> None:
        """Only the ``limit`` newest poses of each frame are kept."""
        self._limit = limit
        self.wanted = wanted
        self._edges: dict[str, dict[str, _Edge]] = {}  # by child and by parent

    @property
    def frames(self) -> list[str]:
        """The names of all frames."""
        parents = (parent for edges in self._edges.values() for parent in edges)
        return sorted({*self._edges, *parents})

    @property
    def moving(self) -> list[str]:
        """The names of the frames of which it was reported that they move in their parent."""
        edges = ((name, self._edge(name)) for name in self._edges)
        return sorted(name for name, edge in edges if edge and edge.standing is None)

    def add(self, transform: Transform) -> None:
        """Add a transform.

        Raises:
            InvalidScanError: its pose is none.
        """
        parent, child, stamp_ns = transform.parent, transform.child, transform.stamp_ns
        if child == parent:
            return
        position, quaternion = transform.numbers()
        edges = self._edges.setdefault(child, {})
        edge = edges.get(parent)
        if edge is None:
            edge = edges[parent] = _Edge(parent, None, Track(self._limit))
        edge.count += 1
        if stamp_ns is STATIC:
            edge.standing = pose_matrices(np.array(position), np.array(quaternion))
            return
        edge.standing = None
        edge.track.add(stamp_ns, position, quaternion)
        # Parents go that nothing was heard of for a while, and the first of very many.
        for rival in list(edges.values()) if self._limit is not None and len(edges) > 1 else ():
            old = rival.standing is None and rival.track.span_ns[1] < stamp_ns - _RIVAL_NS
            if old or len(edges) > _MAX_PARENTS:
                del edges[rival.parent]

    def with_track(self, parent: str, child: str, track: Track) -> "FrameTree":
        """Return a tree that differs in where ``child`` is, and else shares what this one knows."""
        tree = FrameTree(self._limit, self.wanted)
        tree._edges = {**self._edges, child: {parent: _Edge(parent, None, track)}}
        return tree

    def check(self) -> None:
        """Find out which poses two programs publish, so that they are refused from now on."""
        for child, edges in self._edges.items():
            for edge in edges.values():
                if edge.problem is None and edge.standing is None:
                    edge.problem = _of_two(child, edge)

    def problems(self) -> list[tuple[str, str]]:
        """Return the frames whose poses two programs publish by now, each with what to do."""
        found = ((child, self._edge(child)) for child in self.moving)
        told = ((child, _of_two(child, edge)) for child, edge in found if edge is not None)
        return [(child, problem) for child, problem in told if problem]

    def newest_ns(self, child: str) -> int | None:
        """Return the stamp of the newest pose of a frame that moves in its parent."""
        edge = self._edge(child)
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

    @property
    def lowest_moving(self) -> str | None:
        """The frame that moves in its parent and has the most frames above; None: none moves."""
        return max(self.moving, key=lambda frame: len(self._path(frame)), default=None)

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
        return np.asarray(np.linalg.inv(shared_from_target) @ shared_from_frame)

    def moves(self, target: str, frame: str) -> bool:
        """Return whether it was ever reported that ``frame`` moves in ``target``."""
        between = {*self._path(frame)} ^ {*self._path(target)}
        edges = [self._edge(name) for name in between]
        return any(edge is not None and edge.standing is None for edge in edges)

    def corrections(self, target: str, frame: str) -> list[str]:
        """Return what was done with rare transforms between two frames, as remarks."""
        path = self._path(frame)
        path = path[: path.index(target)] if target in path else []
        return [
            _CORRECTION.format(edge.parent, child, edge.track.longest_gap_s)
            for child, edge, corrects in self._steps(path)
            if corrects and edge.track.longest_gap_s > MAX_GAP_S
        ]

    def _path(self, frame: str, below: frozenset[str] = frozenset()) -> list[str]:
        """Return the frame, its parent, and so on up to the root."""
        path = [frame]
        while (edge := self._edge(path[-1], below.union(path))) is not None:
            if edge.parent in path or edge.parent in below:
                break
            path.append(edge.parent)
        return path

    def _edge(self, child: str, below: frozenset[str] = frozenset()) -> _Edge | None:
        """Return the edge to the parent of a frame; of several that remain, the one added last."""
        return next(reversed(self._possible(child, below)), None)

    def _possible(self, child: str, below: frozenset[str] = frozenset()) -> list[_Edge]:
        """Return the edges to the parents of a frame between which nothing decides."""
        edges = list(self._edges.get(child, {}).values())
        if len(edges) < 2:
            return edges
        above = {edge.parent: self._path(edge.parent, below | {child}) for edge in edges}

        def moves(edge: _Edge) -> bool:
            """Where nothing moves, it tells no motion, and is never used."""
            over = [self._edge(name, below | {child}) for name in above[edge.parent]]
            return any(e is not None and e.standing is None for e in (edge, *over))

        for fits in (
            lambda edge: edge.parent == self.wanted,
            lambda edge: self.wanted in above[edge.parent],
            moves,
        ):
            edges = [edge for edge in edges if fits(edge)] or edges
        return edges

    def _steps(self, path: list[str]) -> Iterator[tuple[str, _Edge, bool]]:
        """Yield the edges up a path, and whether each only corrects the motion below it."""
        below: Track | None = None
        for child in path:
            edge = self._edge(child)
            assert edge is not None
            corrects = edge.standing is None and below is not None and edge.track.corrects(below)
            yield child, edge, corrects
            if edge.standing is None and not corrects:
                below = edge.track

    def _climb(self, path: list[str], stamps_ns: Longs) -> Doubles:
        """Return poses of the first frame of a path in the parent of the last."""
        poses = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
        for child, edge, corrects in self._steps(path):
            self._check_single(child, edge)
            if edge.standing is not None:
                poses = edge.standing @ poses
                continue
            try:
                poses = edge.track.poses(stamps_ns, corrects=corrects) @ poses
            except NoTransformError as error:
                text = f"{edge.parent} from {child}: {error}"
                raise NoTransformError(error.reason, text, late=error.late) from None
        return np.array(poses)

    def _check_single(self, child: str, edge: _Edge) -> None:
        possible = self._possible(child)
        if len(possible) > 1 and any(each.standing is None for each in possible):
            parents = " and ".join(
                f"{each.parent} ({each.count} times{', static' * (each.standing is not None)})"
                for each in possible
            )
            choice = " or ".join(f"--map-frame {each.parent}" for each in possible)
            text = f"transforms say where {child} is in {parents}: choose by {choice}"
            raise NoTransformError("two_parents", text)
        if edge.problem:
            raise NoTransformError("two_publishers", edge.problem)

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


def _of_two(child: str, edge: _Edge) -> str:
    """Return which poses two programs publish, if they do."""
    count, metres = edge.track.jumps()
    return _TWO_PUBLISHERS.format(edge.parent, child, count, metres) if count else ""
