"""Questions about the map, which clients and pinned epochs answer alike."""

from numpy.typing import ArrayLike
from triquad_map.questions.align import Alignment, AlignOptions
from triquad_map.questions.distance import DistanceOptions, Distances, Unknown, UnknownLike
from triquad_map.questions.grid import Grid
from triquad_map.questions.ground import Ground
from triquad_map.questions.rays import RayOptions, RayRanges
from triquad_map.questions.segments import Polyline, SegmentOptions, Segments
from triquad_map.questions.spheres import Spheres

from triquad_client.calls import questions
from triquad_client.calls.questions import SdfResult
from triquad_client.checks import Bounds, PoseLike
from triquad_client.net.call import AsyncRun, Call, ResultT, Run
from triquad_client.net.operation import Awaited, Blocking, operation


class QueryOperations:
    """The questions about the map: of its newest epoch, or always of the same one.

    Positions are metres in the map frame. Questions of any size are answered from one epoch,
    a published state of the map that never changes. ``at_epoch`` is its number, ``None`` is the
    newest; once the server does not keep it any more, :class:`RefusedError` with the code
    ``epoch_gone`` is raised, and :class:`InvalidInputError` where an argument cannot be used.
    """

    _epoch: int | None
    """The epoch that is asked where a query names none."""

    @operation
    def query_sdf(
        self, points: ArrayLike, gradient: bool = False, at_epoch: int | None = None
    ) -> Call[SdfResult]:
        """Return the trained field at ``points`` [N, 3]: right near surfaces, saturated beyond.

        Where the map has no region, which is far from all that was seen, field and gradient are
        NaN.

        Args:
            points: metres, map frame.
            gradient: whether the gradient is wanted.
            at_epoch: see :class:`MapQueries`.
        """
        return questions.sdf(points, gradient, self._chosen(at_epoch))

    @operation
    def query_distance(
        self,
        points: ArrayLike,
        max_distance_m: float = 5.0,
        *,
        unknown: UnknownLike = Unknown.FREE,
        surface_point: bool = False,
        unknown_distance: bool = False,
        at_epoch: int | None = None,
    ) -> Call[Distances]:
        """Return true distances to the nearest seen surface, with gradients, at ``points`` [N, 3].

        Args:
            points: metres, map frame.
            max_distance_m: surfaces are searched for up to here, at most 100 m.
            unknown: ``"obstacle"`` lets unknown space count as a surface, ``"error"`` refuses
                points to which it is nearer.
            surface_point: whether the nearest points of the surface are wanted.
            unknown_distance: whether the distance to unknown space is wanted.
            at_epoch: see :class:`MapQueries`.

        Raises:
            UnknownSpaceError: ``unknown`` is ``"error"`` and unknown space is nearer somewhere.
        """
        options = DistanceOptions(max_distance_m, surface_point, unknown_distance)
        return questions.distance(points, options, unknown, at_epoch=self._chosen(at_epoch))

    @operation
    def query_spheres(
        self, centres: ArrayLike, radii_m: ArrayLike, at_epoch: int | None = None
    ) -> Call[Spheres]:
        """Return what spheres at ``centres`` [N, 3] contain; ``radii_m`` are one or [N], metres."""
        return questions.spheres(centres, radii_m, self._chosen(at_epoch))

    @operation
    def query_segments(
        self,
        starts: ArrayLike,
        ends: ArrayLike,
        radius_m: float = 0.0,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Call[Segments]:
        """Return what a ball meets that moves straight from each of ``starts`` to ``ends`` [N, 3].

        Args:
            starts: metres, map frame.
            ends: as many.
            radius_m: of the ball.
            max_distance_m: clearance is searched for up to here, at most 100 m.
            at_epoch: see :class:`MapQueries`.
        """
        options = SegmentOptions(radius_m, max_distance_m)
        return questions.segments(starts, ends, options, at_epoch=self._chosen(at_epoch))

    @operation
    def query_polyline(
        self,
        points: ArrayLike,
        radius_m: float = 0.0,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Call[Polyline]:
        """Return what a ball meets that moves along ``points`` [N, 3]: :meth:`query_segments`."""
        options = SegmentOptions(radius_m, max_distance_m)
        return questions.polyline(points, options, self._chosen(at_epoch))

    @operation
    def query_rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float = 50.0,
        through_unknown: bool = False,
        at_epoch: int | None = None,
    ) -> Call[RayRanges]:
        """Return how far rays reach from ``origins`` [3] or [N, 3] along ``directions`` [N, 3].

        Args:
            origins: metres, map frame.
            directions: of any length but 0.
            max_range_m: at most 1,000 m.
            through_unknown: let unknown space not stop them.
            at_epoch: see :class:`MapQueries`.
        """
        options = RayOptions(max_range_m, through_unknown)
        return questions.rays(origins, directions, options, at_epoch=self._chosen(at_epoch))

    @operation
    def query_ground(
        self, points: ArrayLike, max_drop_m: float = 2.0, at_epoch: int | None = None
    ) -> Call[Ground]:
        """Return the ground below ``points`` [N, 3]: its height and slope, or that there is none.

        Args:
            points: metres, map frame, in free space above the ground, or at most half a voxel
                below it.
            max_drop_m: the ground is searched for down to here, at most 100 m.
            at_epoch: see :class:`MapQueries`.
        """
        return questions.ground(points, max_drop_m, self._chosen(at_epoch))

    @operation
    def query_grid(
        self,
        bounds: Bounds,
        cell_m: float = 0.1,
        max_distance_m: float = 5.0,
        at_epoch: int | None = None,
    ) -> Call[Grid]:
        """Return distance and status at the cubic cells that fill ``bounds``.

        Args:
            bounds: corners of a box; where both have the same z, the grid is a slice there.
            cell_m: side of a cell.
            max_distance_m: surfaces are searched for up to here, at most 100 m.
            at_epoch: see :class:`MapQueries`.
        """
        return questions.grid(bounds, cell_m, max_distance_m, at_epoch=self._chosen(at_epoch))

    @operation
    def align(
        self,
        points: ArrayLike,
        world_from_sensor_guess: PoseLike,
        max_distance_m: float = 6.0,
        at_epoch: int | None = None,
    ) -> Call[Alignment]:
        """Return the pose of a scan: its points are moved until they lie on surfaces of the map.

        Args:
            points: [N, 3] metres, sensor frame; any number, of which some 2,000 are used.
            world_from_sensor_guess: [4, 4]; off by a metre and ten degrees or so at most.
            max_distance_m: points farther than this from any surface do not count.
            at_epoch: see :class:`MapQueries`.
        """
        options = AlignOptions(max_distance_m)
        return questions.align(
            points, world_from_sensor_guess, options, at_epoch=self._chosen(at_epoch)
        )

    def _chosen(self, at_epoch: int | None) -> int | None:
        return self._epoch if at_epoch is None else at_epoch


class MapQueries(QueryOperations, Blocking):
    """Asks about the map: of its newest epoch, or always of the same one.

    Errors and epochs are as :class:`QueryOperations` has them.
    """

    def __init__(self, run: Run, epoch: int | None = None) -> None:
        """``run`` answers the calls; ``epoch`` is asked where a query names none."""
        self._answer_call = run
        self._epoch = epoch

    def _run(self, call: Call[ResultT]) -> ResultT:
        return self._answer_call(call)


class AsyncMapQueries(QueryOperations, Awaited):
    """Asks about the map: :class:`MapQueries` to be awaited."""

    def __init__(self, run: AsyncRun, epoch: int | None = None) -> None:
        """``run`` answers the calls; ``epoch`` is asked where a query names none."""
        self._answer_call = run
        self._epoch = epoch

    async def _run(self, call: Call[ResultT]) -> ResultT:
        return await self._answer_call(call)


class PinnedMap(MapQueries):
    """The map as it was in one epoch.

    The server keeps an epoch for some time after it was last asked (``service.pin_s``, 30 s):
    every query renews it. Once it is removed, queries raise :class:`RefusedError` ``epoch_gone``.
    """

    def __init__(self, run: Run, epoch: int) -> None:
        """Use ``Client.pinned``."""
        super().__init__(run, epoch)
        self.epoch = epoch


class AsyncPinnedMap(AsyncMapQueries):
    """The map as it was in one epoch: :class:`PinnedMap` to be awaited."""

    def __init__(self, run: AsyncRun, epoch: int) -> None:
        """Use ``AsyncClient.pinned``."""
        super().__init__(run, epoch)
        self.epoch = epoch
