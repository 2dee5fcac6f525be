"""Resets the map: its earlier state stays on disk, so that nothing is lost by mistake."""

import logging

from triquad_format.errors import RefusedError
from triquad_format.wire.messages import ResetReply, ResetRequest
from triquad_map.questions.checks import check_box

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
            RefusedError: it is not a box; or the map as it is could not be kept, and was not reset.
        """
        check_box(request.minimum, request.maximum)
        if not self._checkpoints.has_store or self._keep_resets == 0:
            return self._unkept(request)
        try:
            with self._checkpoints.writing:
                reply = self._keep_and_reset(request)
        except StoreError as error:
            raise RefusedError(
                "store", f"nothing was reset, for the map as it is could not be kept: {error}"
            ) from error
        if reply.kept_epoch is not None:
            _log.warning("the map was reset as of epoch %d: %s", reply.epoch, reply.undo)
        return reply

    def _unkept(self, request: ResetRequest) -> ResetReply:
        epoch = self._mapper.call(lambda mapper: self._forget(mapper, request))
        has_store = self._checkpoints.has_store
        why = "store.keep_resets = 0" if has_store else "the server has no store"
        undo = f"the map before was not kept: {why}"
        _log.warning("the map was reset as of epoch %d: %s", epoch, undo)
        return ResetReply(epoch, undo=undo)

    def _forget(self, mapper: Mapper, request: ResetRequest) -> int:
        """Forget what lies in the box; return the epoch that shows it. For the mapper's thread."""
        mapper.reset(request.minimum, request.maximum)
        self._trails.forget(request.minimum, request.maximum)
        return mapper.publish().number

    def _keep_and_reset(self, request: ResetRequest) -> ResetReply:
        """Write the map, and what was learnt meanwhile; then forget what lies in the box."""
        checkpoints = self._checkpoints
        if self._mapper.call(lambda mapper: len(mapper.regions)) > 0:
            checkpoints.write()  # nearly all of it, while mapping goes on
        base = checkpoints.base_epoch

        def keep_and_forget(mapper: Mapper) -> ResetReply:
            """Do so on the mapper's thread: no scan comes in between."""
            if not mapper.regions:
                return ResetReply(self._forget(mapper, request), undo="the map was empty before")
            kept = checkpoints.write_changes(mapper.snapshot_since(base), _UNDOES).epoch
            undo = (
                f"epoch {kept}, the map before, is kept; to go back to it, stop the server and "
                f"start it with --restore {kept}"
            )
            return ResetReply(self._forget(mapper, request), kept, undo)

        return self._mapper.call(keep_and_forget)
