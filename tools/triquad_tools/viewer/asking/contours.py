"""Lines of equal distance on a slice."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from skimage.measure import find_contours
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.asking.slice_plane import Slice

_LINES = 6  # about as many levels
_ROUND = np.array([1.0, 2.0, 5.0, 10.0])
_LEAST_NUMBERED = 0.1  # of the slice's width: length of a line that has its number on it
_ALONG = (0.5, 0.3, 0.7, 0.1, 0.9)  # where on it, whichever is free
_APART = 0.12  # of the slice's width: from one number to the next
_MOST_NUMBERS = 12


@dataclass(frozen=True)
class Contour:
    """A line on which the distance to the nearest surface is the same."""

    level_m: float
    points: Doubles  # [N, 3] metres, map frame

    @property
    def pieces(self) -> Doubles:
        """[N - 1, 2, 3] from each point to the next."""
        return np.stack([self.points[:-1], self.points[1:]], axis=1)

    @property
    def length_m(self) -> float:
        """How long it is."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


def contour_step(max_distance_m: float) -> float:
    """A round distance, metres, from one line to the next."""
    wanted = max_distance_m / _LINES
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * _ROUND[np.argmin(np.abs(np.log(_ROUND * power / wanted)))])


def contours(answer: Slice, max_distance_m: float) -> list[Contour]:
    """The lines of round distances below the largest, and those of the surface itself.

    They end where nothing was seen.
    """
    step_m = contour_step(max_distance_m)
    levels = np.arange(0.0, max_distance_m - 0.5 * step_m, step_m)
    found = []
    for level in levels:
        for line in find_contours(answer.distance_m, level, mask=answer.known):
            found.append(Contour(float(level), answer.plane.places(line[:, 1], line[:, 0])))
    return found


class Number(NamedTuple):
    """The distance of a line, on it."""

    level_m: float
    place: Doubles  # [3] metres, map frame


def numbers(lines: list[Contour], width_m: float) -> list[Number]:
    """Numbers on lines, apart from each other; longer lines come first."""
    found: list[Number] = []
    for line in sorted(lines, key=lambda line: -line.length_m):
        if len(found) == _MOST_NUMBERS or line.length_m < _LEAST_NUMBERED * width_m:
            break
        for share in _ALONG:
            place = line.points[int(share * (len(line.points) - 1))]
            if all(np.linalg.norm(place - other.place) > _APART * width_m for other in found):
                found.append(Number(line.level_m, place))
                break
    return found
