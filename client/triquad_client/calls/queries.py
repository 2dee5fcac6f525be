"""Questions about the map, which clients, pinned epochs and maps in memory answer alike."""

from triquad_client.calls.point_queries import PointQueries
from triquad_client.calls.way_queries import WayQueries
from triquad_client.errors import brief_errors
from triquad_client.net.connection import Answering


class MapQueries(PointQueries, WayQueries):
    """Asks about the map: of its newest epoch, or always of the same one.

    Positions are metres in the map frame. Questions of any size are answered from one epoch,
    a published state of the map that never changes. ``at_epoch`` is its number, ``None`` is the
    newest; once the server does not keep it any more, :class:`RefusedError` with the code
    ``epoch_gone`` is raised, and :class:`InvalidInputError` where an argument cannot be used.
    """


@brief_errors
class PinnedMap(MapQueries):
    """The map as it was in one epoch.

    The server keeps an epoch for some time after it was last asked (``service.pin_s``, 30 s):
    every query renews it. Once it is removed, queries raise :class:`RefusedError` ``epoch_gone``.
    """

    def __init__(self, server: Answering, epoch: int) -> None:
        """Use ``Client.pinned``."""
        self._server = server
        self._epoch = epoch
        self.epoch = epoch

    def __repr__(self) -> str:
        return f"PinnedMap(epoch {self.epoch})"
