"""Resets the map: its earlier state stays on disk, so that nothing is lost by mistake."""

import logging

from triquad_format.errors import RefusedError
from triquad_format.wire.messages import ResetReply, ResetRequest
from triquad_map.questions.checks import check_box

from triquad_server.errors import StoreError
from triquad_server.intake.source_trails import SourceTrails
from triquad_server.mapping.map_snapshot import MapSnapshot
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.store.checkpoint_thread import CheckpointThread
from triquad_server.store.store import Store

_log = logging.getLogger(__name__)

_WHY = "before a reset"


class Resets:
    """Answers reset requests: each first has a checkpoint written that retention must keep."""

    def __init__(
        self,
        mapper: MapperThread,
        checkpoints: CheckpointThread,
        store: Store | None,
        protect_h: float,
        trails: SourceTrails,
    ) -> None:
        """Make the handler; without a ``store``, or with ``protect_h`` = 0, nothing is kept.

        Where sources have been in the box is removed from ``trails``.
        """
        self._mapper = mapper
        self._trails = trails
        self._checkpoints = checkpoints
        self._store = store
        self._protect_h = protect_h

    def answer(self, request: ResetRequest) -> ResetReply:
        """Forget what lies in the request's box, and reply once an epoch shows it.

        Raises:
            RefusedError: it is not a box; or the map as it is could not be kept, and was not reset.
        """
        check_box(request.minimum, request.maximum)
        store = self._store
        if store is None or self._protect_h == 0:
            return self._unkept(request, store)
        try:
            reply = self._checkpoints.call(lambda: self._keep_and_reset(store, request))
        except StoreError as error:
            raise RefusedError(
                "store", f"nothing was reset, for the map as it is could not be kept: {error}"
            ) from error
        if reply.kept_epoch is not None:
            _log.warning("the map was reset as of epoch %d: %s", reply.epoch, reply.undo)
        return reply

    def _unkept(self, request: ResetRequest, store: Store | None) -> ResetReply:
        epoch = self._mapper.call(lambda mapper: self._forget(mapper, request))
        why = "the server has no store" if store is None else "store.protect_h = 0"
        undo = f"the map before was not kept: {why}"
        _log.warning("the map was reset as of epoch %d: %s", epoch, undo)
        return ResetReply(epoch, undo=undo)

    def _forget(self, mapper: Mapper, request: ResetRequest) -> int:
        """Forget what lies in the box; return the epoch that shows it. For the mapper's thread."""
        mapper.reset(request.minimum, request.maximum)
        self._trails.forget(request.minimum, request.maximum)
        return mapper.publish().number

    def _keep_and_reset(self, store: Store, request: ResetRequest) -> ResetReply:
        kept = None
        if self._mapper.call(lambda mapper: len(mapper.regions)) > 0:
            kept = self._checkpoints.write().epoch
            store.protect(kept, _WHY)
        base = store.base_epoch

        def forget(mapper: Mapper) -> tuple[MapSnapshot, int]:
            """Forget it, and return the map just before: no scan comes in between."""
            return mapper.snapshot_since(base), self._forget(mapper, request)

        before, epoch = self._mapper.call(forget)
        kept = self._keep_the_rest(store, before, kept)
        if kept is None:
            return ResetReply(epoch, undo="the map was empty before")
        undo = (
            f"epoch {kept}, the map before, is kept for {self._protect_h:g} h; to go back to it, "
            f"stop the server and start it with --restore {kept}"
        )
        return ResetReply(epoch, kept, undo)

    def _keep_the_rest(self, store: Store, before: MapSnapshot, kept: int | None) -> int | None:
        """Keep what was learnt while the checkpoint was written, too; return the epoch kept."""
        if not before.regions or before.epoch.number == kept:
            return kept
        try:
            written = self._checkpoints.write_changes(before).epoch
            if written != before.epoch.number:  # all of it was needed, and is no longer there
                return kept
            store.protect(written, _WHY, instead_of=kept)
            return written
        except StoreError as error:
            _log.error("what was learnt while the map was being kept is lost: %s", error)
            return kept
