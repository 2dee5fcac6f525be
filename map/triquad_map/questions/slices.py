"""Long questions in slices, between which others have their turn."""

from collections.abc import Callable, Iterator

import numpy as np
from triquad_format.records.arrays import Bytes, Doubles

from triquad_map.questions.joined import joined
from triquad_map.view import FieldAnswer, MapView, NearestSurface, NearestUnknown


class SlicedView:
    """A :class:`MapView` that answers slice by slice, and the same as the map that it shows."""

    def __init__(self, view: MapView, turn: Callable[[], int]) -> None:
        """``turn`` returns when a slice may begin, and how many points it may have, at least 1.

        What it raises ends the question.
        """
        self._view = view
        self._turn = turn

    @property
    def epoch(self) -> int:
        """As of the view."""
        return self._view.epoch

    @property
    def voxel_m(self) -> float:
        """As of the view."""
        return self._view.voxel_m

    def query(self, points: Doubles, gradient: bool = False) -> FieldAnswer:
        """As of the view."""
        return joined([self._view.query(part, gradient) for part in self._slices(points)])

    def status(self, points: Doubles, reach_m: float | None = None) -> Bytes:
        """As of the view."""
        return np.concatenate([self._view.status(part, reach_m) for part in self._slices(points)])

    def nearest_surface(self, points: Doubles, max_distance_m: float) -> NearestSurface:
        """As of the view."""
        slices = self._slices(points)
        parts = [self._view.nearest_surface(part, max_distance_m) for part in slices]
        return NearestSurface._make(map(np.concatenate, zip(*parts, strict=True)))

    def nearest_unknown(self, points: Doubles, max_distance_m: float) -> NearestUnknown:
        """As of the view."""
        slices = self._slices(points)
        return joined([self._view.nearest_unknown(part, max_distance_m) for part in slices])

    def _slices(self, points: Doubles) -> Iterator[Doubles]:
        """The points [N, 3], as many at a time as may be; no points are one slice."""
        first = 0
        while first == 0 or first < len(points):
            last = first + self._turn()
            yield points[first:last]
            first = last
