"""Runs calls on a map that this process holds: each request is answered on the spot."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from triquad_format.wire.codec import Message
from triquad_map.questions.answers import Answers, QuestionError, QuestionLimits
from triquad_map.view import MapView

from triquad_client.errors import RefusedError
from triquad_client.net.call import Batch, Call, Pause, ResultT, Step, finished

_NO_LIMITS = QuestionLimits(points=2**62, searches=2**62)
"""Nobody else waits."""


class LocalDriver:
    """Runs calls over one view; for several threads."""

    def __init__(self, view: MapView) -> None:
        self._view = view
        self._answers = Answers(self._epoch, _NO_LIMITS)

    def run(self, call: Call[ResultT]) -> ResultT:
        """What the call returns; raises what it raises."""
        return finished(call, self._take)

    def _take(self, step: Step) -> Any:
        if isinstance(step, Batch):
            return [self._answer(step.request(item).message) for item in step.items]
        if isinstance(step, Pause):
            return time.sleep(step.seconds)
        return step.job(self.run)

    def _answer(self, request: Message) -> Message:
        try:
            return self._answers.answer(request)
        except QuestionError as error:
            raise RefusedError(error.code, str(error)) from error

    @contextmanager
    def _epoch(self, number: int) -> Iterator[MapView]:
        """The view, where its epoch is asked for, or the newest."""
        if number not in (0, self._view.epoch):
            raise QuestionError(
                "epoch_gone", f"epoch {number} is not kept; kept is [{self._view.epoch}]"
            )
        yield self._view
