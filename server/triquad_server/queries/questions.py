"""Questions about the map, answered slice by slice, as their turns come."""

from collections.abc import Iterator
from contextlib import contextmanager

from triquad_format.wire.codec import Message
from triquad_map.questions.answers import Answers, QuestionLimits, Views
from triquad_map.questions.slices import SlicedView
from triquad_map.view import MapView

from triquad_server.net.request import Request
from triquad_server.net.request_handlers import Handler


class Questions:
    """Answers questions about the map; between slices, others have their turn."""

    def __init__(self, views: Views, limits: QuestionLimits) -> None:
        self._views = views
        self._limits = limits

    def of(self, kind: type[Message]) -> Handler:
        """What handles the questions of a ``kind``."""

        def handle(request: Request) -> None:
            @contextmanager
            def sliced(epoch: int) -> Iterator[MapView]:
                with self._views(epoch) as view:
                    yield SlicedView(view, request.turn)

            request.answer(Answers(sliced, self._limits).answer(request.read(kind)))

        return handle
