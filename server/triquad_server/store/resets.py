"""Resets the map: its earlier state stays on disk, so that nothing is lost by mistake."""

import logging

from triquad_format.errors import RefusedError
from triquad_format.wire.messages import ResetReply, ResetRequest

from triquad_server.errors import StoreError
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.store.checkpoint_writer import CheckpointWriter

_log = logging.getLogger(__name__)

_UNDOES = "a reset"


class Resets:
    """Answers reset requests: each first has the map written to a checkpoint that stays."""

    def __init__(
        self,
        mapper: MapperThread,
        checkpoints: CheckpointWriter,
        keep_resets: int,
        trails: SourceTrails,
    ) -> None:
        """Make the handler; without a store, or with ``keep_resets`` = 0, nothing is kept.

        Where sources have been in the box is removed from ``trails``.
        """
        self._mapper = mapper
        self._trails = trails
        self._checkpoints = checkpoints
        self._keep_resets = keep_resets

    def answer(self, request: ResetRequest) -> ResetReply:
        """Forget what lies in the request's box, and reply once an epoch shows it.

        Raises:
            RefusedError: the map as it is could not be kept, and was not reset.
        """
        emptied = self._mapper.call(lambda mapper: self._forget_empty(mapper, request))
        if emptied is not None:
            return ResetReply(emptied, undo="the map was empty before")
        if not self._checkpoints.has_store or self._keep_resets == 0:
            has_store = self._checkpoints.has_store
            why = "store.keep_resets = 0" if has_store else "the server has no store"
            kept, undo = None, f"the map before was not kept: {why}"
        else:
            kept = self._keep()
            undo = (
                f"epoch {kept}, the map before, is kept; to go back to it, stop the server and "
                f"start it with --restore {kept}"
            )
        epoch = self._mapper.call(lambda mapper: self._forget(mapper, request))
        _log.warning("the map was reset as of epoch %d: %s", epoch, undo)
        return ResetReply(epoch, kept, undo)

    def _keep(self) -> int:
        """Write the map to a checkpoint that stays, and return its epoch; mapping goes on."""
        try:
            return self._checkpoints.write(_UNDOES).epoch
        except StoreError as error:
            raise RefusedError(
                "store", f"nothing was reset, for the map as it is could not be kept: {error}"
            ) from error

    def _forget_empty(self, mapper: Mapper, request: ResetRequest) -> int | None:
        """Do as :meth:`_forget` where nothing is mapped; return None where something is."""
        return None if mapper.regions else self._forget(mapper, request)

    def _forget(self, mapper: Mapper, request: ResetRequest) -> int:
        """Forget what lies in the box; return the epoch that shows it. For the mapper's thread."""
        mapper.reset(request.minimum, request.maximum)
        self._trails.forget(request.minimum, request.maximum)
        return mapper.publish().number
