"""The interface of one region of a map; the composition is put together from this alone."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Ints, Longs
from triquad_format.records.field_settings import FieldSettings, RegionIndex

from triquad_map.view import NearestSurface

_Float = TypeVar("_Float", bound=np.floating)


@dataclass(frozen=True)
class FieldValues:
    """Signed distances [N] and, where asked for, their gradients [N, 3] (else [0, 3])."""

    sdf: Floats
    gradient: Floats


class FieldEngine(Protocol):
    """An engine that computes the field of one region."""

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """Return the field at points [N, 3], metres from the region's centre."""

    def evaluate_in_grid(self, axes: Floats, points: Longs) -> Floats:
        """Return the distance at points of a grid, as :meth:`evaluate` has it but for rounding.

        Args:
            axes: [3, S] coordinates of the grid on each axis, metres from the region's centre.
            points: [N, 3] the points, by their numbers on the axes.
        """


class SeenSpace(Protocol):
    """The space that rays have shown of a region."""

    @property
    def newest_s(self) -> int:
        """The time when a ray last ended anywhere, seconds since 1970; 0: never, or not known."""

    def status(self, voxels: Doubles, reach: float) -> Bytes:
        """Return values of :class:`Status` [N] at leaf coordinates [N, 3].

        ``SURFACE`` reaches ``reach`` voxels beyond those in which rays ended.
        """

    def surface_in_grid(self, axes: Sequence[Doubles], reach: float) -> Bools:
        """Return which points [X, Y, Z] of a grid have the status ``SURFACE``, by :meth:`status`.

        ``axes`` are their leaf coordinates [X], [Y] and [Z], increasing.
        """

    def near_ends(self, voxels: Doubles, reach: float) -> Bools:
        """Return whether leaf coordinates [N, 3] lie where rays ended.

        That is within ``reach`` voxels of one in which they did, on each axis, and not in its
        margins (:attr:`triquad_format.records.region.Evidence.margins`).
        """

    def find_unknown(
        self, voxels: Doubles, blocks: range, distances: Doubles, nearest: Doubles
    ) -> None:
        """Lower ``distances`` [N] to those from ``voxels`` [N, 3] to the nearest unknown voxel.

        Points are leaf coordinates, as are the ``nearest`` [N, 3] of unknown space; distances are
        in voxels. Only blocks whose indices are in ``blocks`` on each axis are searched.
        """


class NearestSurfels(NamedTuple):
    """The nearest surfels of N points of one region, in leaf coordinates; improved in place."""

    distances: Doubles  # [N] voxels; what lies farther than this is not searched for
    closest: Doubles  # [N, 3] their points that are nearest
    means: Doubles  # [N, 3] about the same, over all that is nearly as near
    rows: Ints  # [N] number of the surfel, -1 where there is none


def no_surfels(limits: Doubles) -> NearestSurfels:
    """Return what is known of points before surfels within ``limits`` [N] voxels are found."""
    count = len(limits)
    return NearestSurfels(
        limits.copy(), np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, -1, np.int32)
    )


class RegionFrame(NamedTuple):
    """The place of a region's leaf coordinates in the map, and the time of the query."""

    corner: tuple[float, float, float]  # where they are 0, metres, map frame
    leaf_m: float
    newest_s: int  # when anything in the map was seen last, seconds since 1970


class RegionSurfels(Protocol):
    """The surfels of a region."""

    def __len__(self) -> int: ...

    def improve(self, nearest: NearestSurface, points: Doubles, frame: RegionFrame) -> None:
        """Improve ``nearest`` where a surfel lies nearer to ``points`` [N, 3] of the map frame."""


class FieldRegion(Protocol):
    """A region of which field and status are known."""

    @property
    def index(self) -> RegionIndex:
        """The index of the region."""

    @property
    def centre(self) -> Doubles:
        """[3] metres, map frame."""

    @property
    def engine(self) -> FieldEngine:
        """The engine that computes its field."""

    @property
    def evidence(self) -> SeenSpace:
        """The space that rays have shown of it."""


class MapRegion(FieldRegion, Protocol):
    """A region of which all is known; surfels may be made when they are asked for."""

    @property
    def surfels(self) -> RegionSurfels:
        """The surfels of its surface. They must not be asked for within a :class:`Split`."""


def in_grid(axes: NDArray[_Float], points: Longs) -> NDArray[_Float]:
    """Return points [N, 3] of a grid with coordinates ``axes`` [3, S], by their numbers there."""
    places = [axis[numbers] for axis, numbers in zip(axes, points.T, strict=True)]
    return np.stack(places, axis=1)


Work = Callable[[int, int], None]
"""Does the part ``range(first, last)`` of some work."""


class Split(Protocol):
    """Runs work over ``range(count)``, in parts at the same time where it is worth it."""

    def __call__(self, count: int, work: Work, least: int = ...) -> None:
        """Run work; ``least`` is how many a part has at least, where the default is too many."""


class RecordedRegion:
    """A region as a file has it, whose surfels are fitted when they are first asked for."""

    def __init__(
        self,
        settings: FieldSettings,
        index: RegionIndex,
        engine: FieldEngine,
        evidence: SeenSpace,
        fit: Callable[[], RegionSurfels],
    ) -> None:
        """Take ``fit`` to make the surfels, which takes a while; it is called once at most."""
        self.index = index
        self.centre = settings.region_centre(index)
        self.engine = engine
        self.evidence = evidence
        self._fit = fit
        self._fitting = threading.Lock()
        self._surfels: RegionSurfels | None = None

    @property
    def surfels(self) -> RegionSurfels:
        """The surfels of its surface; the first who asks waits until all are fitted."""
        with self._fitting:
            if self._surfels is None:
                self._surfels = self._fit()
            return self._surfels
