"""The frames that robots report, and which of them each is in."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.pose import pose_matrices

from triquad_tools.sensors.motion.track import STATIC, Track, Transform
from triquad_tools.sensors.sweep import NoScanError

_RIVAL_NS = 10 * 10**9  # after which a parent counts no more, of which nothing was heard since
_RESTART_NS = 10 * 10**9  # transforms that go back by more are of a bag that was started again
_MAX_PARENTS, _MAX_FRAMES = 8, 1000  # of a frame and in all: their names come from the network

_TWO_PUBLISHERS = (
    "{} from {} jumps to and fro, {} times, by {:.2g} m: two programs publish it; choose the topic "
    "of one, or other poses, by --poses"
)

ROOT_NAMES = ("map", "odom", "world")  # stand still (REP 105), in order of preference


@dataclass
class Edge:
    """How a frame stands or moves in one parent."""

    parent: str
    child: str
    track: Track
    standing: Doubles | None = None  # [4, 4] where it always holds
    count: int = 0  # of transforms
    refused: str = ""  # why its poses are of no use

    def problem(self) -> str:
        """Return that two programs publish its poses, if they do."""
        count, metres = self.track.jumps() if self.standing is None else (0, 0.0)
        return _TWO_PUBLISHERS.format(self.parent, self.child, count, metres) if count else ""


class FrameGraph:
    """Frames in their parents.

    A frame has one parent. Where transforms name several, ``wanted`` may decide, which is one of
    them or a frame above one; else the one that was added last counts.
    """

    def __init__(self, limit: int | None = None, wanted: str = "") -> None:
        """Only the ``limit`` newest poses of each frame are kept, of as many frames as may be."""
        self._limit = limit
        self.wanted = wanted
        self._edges: dict[str, dict[str, Edge]] = {}  # by child and by parent

    @property
    def frames(self) -> list[str]:
        """The names of all frames."""
        parents = (parent for edges in self._edges.values() for parent in edges)
        return sorted({*self._edges, *parents})

    @property
    def moving(self) -> list[Edge]:
        """Of each frame of which it was reported that it moves in its parent, how it does."""
        edges = (self.edge(name) for name in sorted(self._edges))
        return [edge for edge in edges if edge is not None and edge.standing is None]

    def add(self, transform: Transform) -> None:
        """Add a transform.

        Raises:
            InvalidScanError: its pose is none.
            NoScanError: there are too many frames already.
        """
        parent, child, stamp_ns = transform.parent, transform.child, transform.stamp_ns
        if child == parent:
            return
        position, quaternion = transform.numbers()
        if self._limit is not None and child not in self._edges:
            if len(self._edges) >= _MAX_FRAMES:
                raise NoScanError("bad_transform", f"more than {_MAX_FRAMES} frames")
        elif self._limit is not None and stamp_ns is not STATIC:
            self._forget_after(self.edge(child), stamp_ns)
        edges = self._edges.setdefault(child, {})
        edge = edges.get(parent)
        if edge is None:
            edge = edges[parent] = Edge(parent, child, Track(self._limit))
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

    def forget_after(self, stamp_ns: int) -> None:
        """Remove the poses of frames that have some from before time went back to a stamp."""
        for edge in self.moving:
            self._forget_after(edge, stamp_ns)

    def edge(self, child: str, below: frozenset[str] = frozenset()) -> Edge | None:
        """Return the edge to the parent of a frame; of several that remain, the one added last.

        Those ``below`` it are no parents.
        """
        return next(reversed(self.possible(child, below)), None)

    def possible(self, child: str, below: frozenset[str] = frozenset()) -> list[Edge]:
        """Return the edges to the parents of a frame between which nothing decides."""
        edges = list(self._edges.get(child, {}).values())
        if len(edges) < 2:
            return edges
        above = {edge.parent: self.path(edge.parent, below | {child}) for edge in edges}

        def moves(edge: Edge) -> bool:
            """Where nothing moves, it tells no motion, and is never used."""
            over = [self.edge(name, below | {child}) for name in above[edge.parent]]
            return any(e is not None and e.standing is None for e in (edge, *over))

        for fits in (
            lambda edge: edge.parent == self.wanted,
            lambda edge: self.wanted in above[edge.parent],
            moves,
        ):
            edges = [edge for edge in edges if fits(edge)] or edges
        return edges

    def path(self, frame: str, below: frozenset[str] = frozenset()) -> list[str]:
        """Return the frame, its parent, and so on up to the root."""
        path = [frame]
        while (edge := self.edge(path[-1], below.union(path))) is not None:
            if edge.parent in path or edge.parent in below:
                break
            path.append(edge.parent)
        return path

    def root(self, frame: str) -> str:
        """Return the topmost ancestor of ``frame``; itself if it has no parent."""
        return self.path(frame)[-1]

    def fixed_frame(self, frame: str) -> str:
        """Return the frame to map in: of those above ``frame`` a usual one, or else the root."""
        path = self.path(frame)
        return next((name for name in ROOT_NAMES if name in path), path[-1])

    def moves(self, target: str, frame: str) -> bool:
        """Return whether it was ever reported that ``frame`` moves in ``target``."""
        edges = map(self.edge, {*self.path(frame)} ^ {*self.path(target)})
        return any(edge is not None and edge.standing is None for edge in edges)

    def is_world(self, target: str, frame: str) -> bool:
        """Return whether ``frame`` stands still in ``target`` while others move in it."""
        if self.moves(target, frame):
            return False
        return any(frame in self.path(edge.parent) for edge in self.moving)

    def _forget_after(self, edge: Edge | None, stamp_ns: int) -> None:
        is_moving = edge is not None and edge.standing is None
        if edge is not None and is_moving and edge.track.span_ns[1] > stamp_ns + _RESTART_NS:
            del self._edges[edge.child]
