"""Runs calls on a map that this process holds: each request is answered on the spot."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from triquad_format.errors import RefusedError
from triquad_format.records.region import MapRecord
from triquad_map.questions.answers import Answers, QuestionLimits
from triquad_map.record_view import open_view
from triquad_map.view import MapView

from triquad_client.net.call import Batch
from triquad_client.net.driver import BlockingDriver

_NO_LIMITS = QuestionLimits(points=2**62, searches=2**62)
"""Nobody else waits."""


class LocalDriver(BlockingDriver):
    """Runs calls over the map in a record, as fast as possible here; for several threads."""

    def __init__(self, record: MapRecord) -> None:
        self._open = open_view(record)
        self._view = self._open.view
        self._answers = Answers(self._epoch, _NO_LIMITS)

    @property
    def compiled(self) -> bool:
        """Whether compiled code answers, as in a server; else numpy, which is far slower."""
        return self._open.compiled

    def close(self) -> None:
        """End the threads that compiled code works on; nothing may be asked any more."""
        self._open.close()

    async def _replies(self, batch: Batch) -> list[Any]:
        return [self._answers.answer(batch.request(item).message) for item in batch.items]

    @contextmanager
    def _epoch(self, number: int) -> Iterator[MapView]:
        """The view, where its epoch is asked for, or the newest."""
        if number not in (0, self._view.epoch):
            raise RefusedError(
                "epoch_gone", f"epoch {number} is not kept; kept is [{self._view.epoch}]"
            )
        yield self._view
