"""Questions about the map, to be awaited."""

from numpy.typing import ArrayLike
from triquad_map.questions.align import Alignment, AlignOptions
from triquad_map.questions.distance import DistanceOptions, Distances, Unknown, UnknownLike
from triquad_map.questions.grid import Grid
from triquad_map.questions.ground import Ground
from triquad_map.questions.rays import RayOptions, RayRanges
from triquad_map.questions.segments import Polyline, SegmentOptions, Segments
from triquad_map.questions.spheres import Spheres

from triquad_client.calls import questions
from triquad_client.calls.queries import MapQueries
from triquad_client.calls.questions import SdfResult
from triquad_client.checks import Bounds, PoseLike
from triquad_client.documentation import documented_as
from triquad_client.net.call import AsyncRun


@documented_as(MapQueries)
class AsyncMapQueries:
    """Asks about the map: :class:`MapQueries` to be awaited."""

    def __init__(self, run: AsyncRun, epoch: int | None = None) -> None:
        """``run`` answers the calls; ``epoch`` is asked where a query names none."""
        self._run = run
        self._epoch = epoch

    async def query_sdf(
        self, points: ArrayLike, gradient: bool = False, at_epoch: int | None = None
    ) -> SdfResult:
        return await self._run(questions.sdf(points, gradient, self._chosen(at_epoch)))

    async def query_distance(
        self,
        points: ArrayLike,
        max_distance_m: float = 5.0,
        *,
        unknown: UnknownLike = Unknown.FREE,
        surface_point: bool = False,
        unknown_distance: bool = False,
        at_epoch: int | None = None,
    ) -> Distances:
        options = DistanceOptions(max_distance_m, surface_point, unknown_distance)
        return await self._run(
            questions.distance(points, options, unknown, at_epoch=self._chosen(at_epoch))
        )

    async def query_spheres(
        self, centres: ArrayLike, radii_m: ArrayLike, at_epoch: int | None = None
    ) -> Spheres:
        return await self._run(questions.spheres(centres, radii_m, self._chosen(at_epoch)))

    async def query_segments(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        radius_m: float = 0.0,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Segments:
        options = SegmentOptions(radius_m, max_distance_m)
        return await self._run(
            questions.segments(starts, ends, options, at_epoch=self._chosen(at_epoch))
        )

    async def query_polyline(
        self,
        points: ArrayLike,
        radius_m: float = 0.0,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Polyline:
        options = SegmentOptions(radius_m, max_distance_m)
        return await self._run(questions.polyline(points, options, self._chosen(at_epoch)))

    async def query_rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float = 50.0,
        through_unknown: bool = False,
        at_epoch: int | None = None,
    ) -> RayRanges:
        options = RayOptions(max_range_m, through_unknown)
        return await self._run(
            questions.rays(origins, directions, options, at_epoch=self._chosen(at_epoch))
        )

    async def query_ground(
        self, points: ArrayLike, max_drop_m: float = 2.0, at_epoch: int | None = None
    ) -> Ground:
        return await self._run(questions.ground(points, max_drop_m, self._chosen(at_epoch)))

    async def query_grid(
        self,
        bounds: Bounds,
        cell_m: float = 0.1,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Grid:
        call = questions.grid(bounds, cell_m, max_distance_m, at_epoch=self._chosen(at_epoch))
        return await self._run(call)

    async def align(
        self,
        points: ArrayLike,
        world_from_sensor_guess: PoseLike,
        max_distance_m: float = 6.0,
        at_epoch: int | None = None,
    ) -> Alignment:
        options = AlignOptions(max_distance_m)
        call = questions.align(
            points, world_from_sensor_guess, options, at_epoch=self._chosen(at_epoch)
        )
        return await self._run(call)

    def _chosen(self, at_epoch: int | None) -> int | None:
        return self._epoch if at_epoch is None else at_epoch


class AsyncPinnedMap(AsyncMapQueries):
    """The map as it was in one epoch: :class:`PinnedMap` to be awaited."""

    def __init__(self, run: AsyncRun, epoch: int) -> None:
        """Use ``AsyncClient.pinned``."""
        super().__init__(run, epoch)
        self.epoch = epoch
