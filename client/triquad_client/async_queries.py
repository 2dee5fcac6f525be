"""Questions about the map, to be awaited."""

from typing import Protocol

from numpy.typing import ArrayLike

from triquad_client import sdf
from triquad_client.call import Call, ResultT
from triquad_client.sdf import SdfResult


class AsyncRun(Protocol):
    """Runs calls to their end, without holding up the event loop."""

    async def __call__(self, call: Call[ResultT]) -> ResultT:
        """What the call returns; raises what it raises."""
        ...


class AsyncMapQueries:
    """As :class:`MapQueries`, to be awaited."""

    def __init__(self, run: AsyncRun, epoch: int | None = None) -> None:
        """``run`` answers the calls; ``epoch`` is asked where a query names none."""
        self._run = run
        self._epoch = epoch

    async def query_sdf(
        self, points: ArrayLike, gradient: bool = False, at_epoch: int | None = None
    ) -> SdfResult:
        """As :meth:`MapQueries.query_sdf`."""
        return await self._run(sdf.query(points, gradient, self._chosen(at_epoch)))

    async def query_gradient(self, points: ArrayLike, at_epoch: int | None = None) -> SdfResult:
        """As :meth:`query_sdf`, with the gradient."""
        return await self.query_sdf(points, gradient=True, at_epoch=at_epoch)

    def _chosen(self, at_epoch: int | None) -> int | None:
        return self._epoch if at_epoch is None else at_epoch


class AsyncPinnedMap(AsyncMapQueries):
    """As :class:`PinnedMap`, to be awaited."""

    def __init__(self, run: AsyncRun, epoch: int) -> None:
        """Use ``AsyncClient.pinned``."""
        super().__init__(run, epoch)
        self.epoch = epoch
