"""Whether a robot can move along a path, and how near it comes to what."""

from dataclasses import dataclass

import numpy as np
from triquad_client import Polyline, Segments
from triquad_client.calls.queries import MapQueries
from triquad_format.records.arrays import Doubles
from triquad_format.wire.limits import MAX_DISTANCE_M

_LEAST_REACH_M, _REACH_RADII = 1.0, 3.0  # how far around surfaces are looked for
_LEAST_PIECE_M = 0.25
_MOST_PIECES = 400


@dataclass(frozen=True)
class PathAnswer:
    """What a map says about a path, of one epoch."""

    points: Doubles  # [N, 3] metres, map frame: where it was laid
    radius_m: float
    reach_m: float  # clearance is told up to here
    whole: Polyline
    cuts: Doubles  # [P + 1, 3] the ends of short pieces of it
    pieces: Segments  # P of them

    def at(self, along_m: float) -> Doubles:
        """The point [3] so far along the path."""
        lengths = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        ends_m = np.concatenate([[0.0], np.cumsum(lengths)])
        return np.array([np.interp(along_m, ends_m, axis) for axis in self.points.T])


def ask_path(queries: MapQueries, points: Doubles, radius_m: float) -> PathAnswer:
    """Ask about a ball that moves along ``points`` [N, 3], at least two, metres, map frame.

    Raises:
        TriquadError: the map does not answer, or not about so long a path.
    """
    reach_m = min(max(_LEAST_REACH_M, _REACH_RADII * radius_m), MAX_DISTANCE_M)
    whole = queries.query_polyline(points, radius_m, reach_m)
    cuts = in_pieces(points)
    pieces = queries.query_segments(cuts[:-1], cuts[1:], radius_m, reach_m, at_epoch=whole.epoch)
    return PathAnswer(points, radius_m, reach_m, whole=whole, cuts=cuts, pieces=pieces)


def in_pieces(points: Doubles) -> Doubles:
    """The path through ``points`` [N, 3] with more points [P + 1, 3] on it, evenly between them."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    piece_m = max(_LEAST_PIECE_M, float(lengths.sum()) / _MOST_PIECES)
    counts = np.maximum(np.ceil(lengths / piece_m), 1).astype(np.int64)
    legs = [
        start + (end - start) * (np.arange(count) / count)[:, None]
        for start, end, count in zip(points[:-1], points[1:], counts, strict=True)
    ]
    return np.concatenate([*legs, points[-1:]])
