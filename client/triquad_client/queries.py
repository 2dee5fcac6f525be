"""Questions about the map, which clients and pinned epochs answer alike."""

from numpy.typing import ArrayLike

from triquad_client import sdf
from triquad_client.call import Run
from triquad_client.sdf import SdfResult


class MapQueries:
    """Asks about the map: of its newest epoch, or always of the same one."""

    def __init__(self, run: Run, epoch: int | None = None) -> None:
        """``run`` answers the calls; ``epoch`` is asked where a query names none."""
        self._run = run
        self._epoch = epoch

    def query_sdf(
        self, points: ArrayLike, gradient: bool = False, at_epoch: int | None = None
    ) -> SdfResult:
        """Signed distance and status, on request also the gradient, at ``points`` [N, 3].

        Queries of any size are answered from one epoch.

        Args:
            points: metres, map frame.
            gradient: whether the gradient is wanted.
            at_epoch: number of the epoch that answers; ``None``: the newest.

        Raises:
            RefusedError: ``epoch_gone``: the server does not keep ``at_epoch`` any more.
        """
        return self._run(sdf.query(points, gradient, self._chosen(at_epoch)))

    def query_gradient(self, points: ArrayLike, at_epoch: int | None = None) -> SdfResult:
        """As :meth:`query_sdf`, with the gradient."""
        return self.query_sdf(points, gradient=True, at_epoch=at_epoch)

    def _chosen(self, at_epoch: int | None) -> int | None:
        return self._epoch if at_epoch is None else at_epoch


class PinnedMap(MapQueries):
    """The map as it was in one epoch.

    The server keeps an epoch for some time after it was last asked (``service.pin_s``, 30 s):
    every query renews it. Once it is gone, queries raise :class:`RefusedError` ``epoch_gone``.
    """

    def __init__(self, run: Run, epoch: int) -> None:
        """Use ``Client.pinned``."""
        super().__init__(run, epoch)
        self.epoch = epoch
