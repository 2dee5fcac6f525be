"""Plan the path of a ball with RRT-Connect (Kuffner and LaValle 2000), in batches."""

import argparse

import numpy as np
import triquad_client
from numpy.typing import NDArray
from triquad_client import PinnedMap, Status

BATCH = 64  # samples that share a request
STEP_M = 3.0  # a tree grows by at most so much at a time
ROUNDS = 200

Places = NDArray[np.float64]


class Tree:
    """Places that can be reached from its root."""

    def __init__(self, root: Places) -> None:
        self.places = root[None]
        self.parents = [0]

    def nearest(self, points: Places) -> NDArray[np.intp]:
        """The place nearest to each of ``points`` [N, 3]."""
        return np.linalg.norm(points[:, None] - self.places, axis=2).argmin(axis=1)

    def grow(self, view: PinnedMap, points: Places, radius: float) -> NDArray[np.intp]:
        """Grow towards ``points`` [N, 3]; returns the new places."""
        parents = self.nearest(points)
        starts = self.places[parents]
        lengths = np.linalg.norm(points - starts, axis=1, keepdims=True)
        ends = starts + (points - starts) * np.minimum(1, STEP_M / np.maximum(lengths, 1e-9))
        # Unknown space counts as an obstacle unless free() is told otherwise.
        free = view.query_segments(starts, ends, radius).free()
        self.places = np.concatenate([self.places, ends[free]])
        self.parents += parents[free].tolist()
        return np.arange(len(self.places) - free.sum(), len(self.places))

    def way(self, place: int) -> list[Places]:
        """From a place back to the root."""
        way = [self.places[place]]
        while place:
            place = self.parents[place]
            way.append(self.places[place])
        return way


def plan(
    view: PinnedMap, ends: tuple[Places, Places], box: tuple[Places, Places], radius: float
) -> Places | None:
    """A path [N, 3] between two ends within a box; ``None`` where none was found."""
    rng = np.random.default_rng(0)
    one, other = Tree(ends[0]), Tree(ends[1])
    for _ in range(ROUNDS):
        new = one.grow(view, rng.uniform(*box, (BATCH, 3)), radius)
        if len(new):
            near = other.nearest(one.places[new])
            free = view.query_segments(one.places[new], other.places[near], radius).free()
            if free.any():
                at = int(free.argmax())
                path = np.array(one.way(int(new[at]))[::-1] + other.way(int(near[at])))
                return path if np.array_equal(path[0], ends[0]) else path[::-1]
        one, other = other, one
    return None


def shorten(view: PinnedMap, path: Places, radius: float) -> Places:
    """The shortest way along free straights between the corners of a path, all in one request."""
    first, last = np.triu_indices(len(path), k=1)
    free = view.query_segments(path[first], path[last], radius).free()
    lengths = np.full((len(path), len(path)), np.inf)
    lengths[first[free], last[free]] = np.linalg.norm(path[last] - path[first], axis=1)[free]
    length, before = np.zeros(len(path)), np.zeros(len(path), np.intp)
    for corner in range(1, len(path)):
        ways = length[:corner] + lengths[:corner, corner]
        before[corner] = ways.argmin()
        length[corner] = ways.min()
    corners = [len(path) - 1]
    while corners[-1]:
        corners.append(int(before[corners[-1]]))
    return path[corners[::-1]]


def main() -> None:
    """Plan across the demo's street and check the path in the newest map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--map", default="demo")
    parser.add_argument("--start", type=float, nargs=3, default=(2.0, -6.5, 1.2), metavar="M")
    parser.add_argument("--goal", type=float, nargs=3, default=(24.0, 10.5, 1.2), metavar="M")
    parser.add_argument("--low", type=float, nargs=3, default=(0.0, -9.0, 0.6), metavar="M")
    parser.add_argument("--high", type=float, nargs=3, default=(30.0, 12.0, 3.0), metavar="M")
    parser.add_argument("--radius", type=float, default=0.4, help="of the ball, metres")
    options = parser.parse_args()
    ends = (np.array(options.start), np.array(options.goal))
    with triquad_client.connect(options.connect, options.map) as client:
        view = client.pinned()
        for name, status in zip(
            ("start", "goal"), view.query_spheres(ends, options.radius).status, strict=True
        ):
            if status != Status.FREE:
                raise SystemExit(f"the {name} is not free: {Status(status).name}")
        path = plan(view, ends, (np.array(options.low), np.array(options.high)), options.radius)
        if path is None:
            raise SystemExit(f"no path found in {ROUNDS} rounds")
        path = shorten(view, path, options.radius)
        print(path.round(2))
        # The map has gone on meanwhile: what is driven must be free in the newest one.
        now = client.query_polyline(path, options.radius)
        print(f"planned in epoch {view.epoch}, checked in epoch {now.epoch}: free {now.free()}")
        print(
            f"{now.length_m:.1f} m, clearance {now.clearance_m:.2f} m at {now.clearance_at_m:.1f} m"
        )


if __name__ == "__main__":
    main()
