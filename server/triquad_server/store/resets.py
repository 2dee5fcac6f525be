"""Forgets what lies in a box; the map as it was stays on disk."""

import logging

from triquad_format.errors import RefusedError
from triquad_format.wire.messages import ResetReply, ResetRequest

from triquad_server.errors import StoreError
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.store.checkpoint_writer import CheckpointWriter

_log = logging.getLogger(__name__)


def way_back(kept: int) -> str:
    """Return how to go back to the map before, which is kept as epoch ``kept``."""
    return (
        f"epoch {kept}, the map before, is kept; to go back to it, stop the server and start "
        f"it with --restore {kept}"
    )


class Resets:
    """Resets parts of a map."""

    def __init__(
        self, mapper: MapperThread, checkpoints: CheckpointWriter, trails: SourceTrails
    ) -> None:
        """Reset the map of ``mapper``, with its checkpoints, and the ``trails`` of its sources."""
        self._mapper = mapper
        self._checkpoints = checkpoints
        self._trails = trails

    def answer(self, request: ResetRequest) -> ResetReply:
        """Forget what lies in the request's box, and reply once an epoch shows it.

        The map as it was stays on disk, so that nothing is lost by mistake. Where sources have been
        in the box is removed from their trails.

        Raises:
            RefusedError: the map as it is could not be kept, and was not reset.
        """
        store, trails = self._checkpoints.store, self._trails

        def forget(mapper: Mapper) -> int:
            mapper.reset(request.minimum, request.maximum)
            if store is not None:
                corners = request.minimum + mapper.origin, request.maximum + mapper.origin
                store.scans.add_reset(*corners)
            trails.forget(request.minimum, request.maximum)
            return mapper.publish().number

        emptied = self._mapper.call(lambda mapper: None if mapper.regions else forget(mapper))
        if emptied is not None:
            return ResetReply(emptied, undo="the map was empty before")
        kept, undo = self._keep()
        epoch = self._mapper.call(forget)
        _log.warning("the map was reset as of epoch %d: %s", epoch, undo)
        return ResetReply(epoch, kept, undo)

    def _keep(self) -> tuple[int | None, str]:
        """Write the map to a checkpoint that stays; return its epoch, and how to go back to it.

        Raises:
            RefusedError: it cannot be written.
        """
        store = self._checkpoints.store
        if store is None or store.keep_resets == 0:
            why = "store.keep_resets = 0" if store else "the server has no store"
            return None, f"the map before was not kept: {why}"
        try:
            kept = self._checkpoints.write("a reset").epoch
        except StoreError as error:
            raise RefusedError(
                "store", f"nothing was reset, for the map as it is could not be kept: {error}"
            ) from error
        return kept, way_back(kept)
