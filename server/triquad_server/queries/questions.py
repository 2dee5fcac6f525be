"""Questions about the map, answered slice by slice, as their turns come."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from triquad_format.wire.codec import Message
from triquad_map.questions.answers import Answers, QuestionLimits, Views
from triquad_map.questions.slices import SlicedView
from triquad_map.view import MapView

from triquad_server.net.request import Request
from triquad_server.net.request_handlers import Handler


class Questions:
    """Answers questions about the map; between slices, others have their turn."""

    def __init__(self, views: Views, limits: QuestionLimits, give_way: Callable[[], None]) -> None:
        """``give_way`` returns when a slice may begin, as far as other work than questions goes."""
        self._views = views
        self._limits = limits
        self._give_way = give_way

    def of(self, kind: type[Message]) -> Handler:
        """What handles the questions of a ``kind``."""

        def handle(request: Request) -> None:
            def turn() -> int:
                self._give_way()
                return request.turn()

            @contextmanager
            def sliced(epoch: int) -> Iterator[MapView]:
                with self._views(epoch) as view:
                    yield SlicedView(view, turn)

            request.answer(Answers(sliced, self._limits).answer(request.read(kind)))

        return handle
