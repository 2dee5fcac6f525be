"""The poses of frames in each other over time."""

from collections.abc import Iterator

import numpy as np
from triquad_format.records.arrays import Doubles, Longs

from triquad_tools.sensors.motion.frame_graph import Edge, FrameGraph
from triquad_tools.sensors.motion.track import MAX_GAP_S, Track
from triquad_tools.sensors.sweep import NoTransformError

_CORRECTION = (
    "{} from {} comes up to {:.1f} s apart: where it moved by no more than drift does, it is taken "
    "to move evenly between, else to stay as it was until the next"
)


class FrameTree(FrameGraph):
    """Transforms over time, and the poses of a frame in another.

    A pose that depends on the parent of a frame that has several is refused.
    """

    def with_track(self, parent: str, child: str, track: Track) -> "FrameTree":
        """Return a tree that differs in where ``child`` is, and else shares what this one knows."""
        tree = FrameTree(self._limit, self.wanted)
        tree._edges = {**self._edges, child: {parent: Edge(parent, child, track)}}
        return tree

    def check(self) -> None:
        """Find out which poses two programs publish, so that they are refused from now on."""
        for edges in self._edges.values():
            for edge in edges.values():
                edge.refused = edge.problem()

    def poses(self, target: str, frame: str, stamps_ns: Longs) -> Doubles:
        """Return poses [M, 4, 4] ``target_from_frame`` at times [M].

        Raises:
            NoTransformError: the frames do not hang together, or not at those times.
        """
        up, down = self.path(frame), self.path(target)
        shared = next((name for name in up if name in down), None)
        if shared is None:
            raise self._unconnected(target, frame)
        shared_from_frame = self._climb(up[: up.index(shared)], stamps_ns)
        shared_from_target = self._climb(down[: down.index(shared)], stamps_ns)
        return np.asarray(np.linalg.inv(shared_from_target) @ shared_from_frame)

    def corrections(self, target: str, frame: str) -> list[str]:
        """Return what was done with rare transforms between two frames, as remarks."""
        path = self.path(frame)
        path = path[: path.index(target)] if target in path else []
        return [
            _CORRECTION.format(edge.parent, edge.child, edge.track.longest_gap_s)
            for edge, corrects in self._steps(path)
            if corrects and edge.track.longest_gap_s > MAX_GAP_S
        ]

    def _steps(self, path: list[str]) -> Iterator[tuple[Edge, bool]]:
        """Yield the edges up a path, and whether each only corrects the motion below it."""
        below: Track | None = None
        for child in path:
            edge = self.edge(child)
            assert edge is not None
            corrects = edge.standing is None and below is not None and edge.track.corrects(below)
            yield edge, corrects
            if edge.standing is None and not corrects:
                below = edge.track

    def _climb(self, path: list[str], stamps_ns: Longs) -> Doubles:
        """Return poses of the first frame of a path in the parent of the last."""
        poses = np.broadcast_to(np.eye(4), (len(stamps_ns), 4, 4))
        for edge, corrects in self._steps(path):
            self._check_single(edge)
            if edge.standing is not None:
                poses = edge.standing @ poses
                continue
            try:
                poses = edge.track.poses(stamps_ns, corrects=corrects) @ poses
            except NoTransformError as error:
                text = f"{edge.parent} from {edge.child}: {error}"
                raise NoTransformError(error.reason, text, late=error.late) from None
        return np.array(poses)

    def _check_single(self, edge: Edge) -> None:
        possible = self.possible(edge.child)
        if len(possible) > 1 and any(each.standing is None for each in possible):
            parents = " and ".join(
                f"{each.parent} ({each.count} times{', static' * (each.standing is not None)})"
                for each in possible
            )
            choice = " or ".join(f"--map-frame {each.parent}" for each in possible)
            text = f"transforms say where {edge.child} is in {parents}: choose by {choice}"
            raise NoTransformError("two_parents", text)
        if edge.refused:
            raise NoTransformError("two_publishers", edge.refused)

    def _unconnected(self, target: str, frame: str) -> NoTransformError:
        frames, known = self.frames, ", ".join(self.frames[:10]) or "none"
        if frame not in frames:
            text = f"no transform names the frame {frame!r} (known: {known})"
        elif target not in frames:
            text = f"no transform names the map frame {target!r}: {frame} is in {self.root(frame)}"
        else:
            text = (
                f"{frame} is in {self.root(frame)} and {target} in {self.root(target)}, and no "
                "transform connects the two"
            )
        return NoTransformError("no_transform", text, late=True)
