"""A map in memory that answers requests as a server does."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from triquad_format.errors import RefusedError
from triquad_format.records.region import MapRecord
from triquad_format.wire.codec import Request, asked_from
from triquad_map.opening import open_view
from triquad_map.questions.answers import Answers
from triquad_map.view import MapView

from triquad_client.errors import ClosedError
from triquad_client.net.connection import Answering, ReplyT

if TYPE_CHECKING:
    from triquad_map.composition.composed_view import RecordedView


class LocalMap(Answering):
    """Answers requests about the map in a record, as fast as possible here; for several threads."""

    def __init__(self, record: MapRecord, *, local: bool = False) -> None:
        self._opened: RecordedView | None = open_view(record)
        self._answers = Answers(self._epoch)
        self.origin = record.origin * (not local)
        """[3] from where the map counts, in the coordinates of requests: 0 if those are local."""

    @property
    def view(self) -> RecordedView:
        """The map.

        Raises:
            ClosedError: it was closed.
        """
        if self._opened is None:
            raise ClosedError("the map is closed")
        return self._opened

    def close(self) -> None:
        """Release the map; what is asked later raises :class:`ClosedError`."""
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()

    def replies(self, requests: Iterable[Request[ReplyT]]) -> Iterator[ReplyT]:
        """Yield the reply to each request, one after the other."""
        return (asked_from(self.origin, self._answers.answer, request) for request in requests)

    @contextmanager
    def _epoch(self, number: int) -> Iterator[MapView]:
        """Yield the view, where its epoch is asked for, or the newest."""
        view = self.view
        if number not in (0, view.epoch):
            raise RefusedError("epoch_gone", f"epoch {number} is not kept; kept is [{view.epoch}]")
        yield view
