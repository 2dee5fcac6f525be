"""What each request gets: from its message to the answer's message."""

from collections.abc import Iterator
from contextlib import contextmanager

from triquad_format.wire.messages import ResetReply, ResetRequest

from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.epochs import EpochShelf
from triquad_server.epochs.gate import QueryGate
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.mesh.request_checks import check_box


class EpochViews:
    """The epochs as questions see them; training gives way while one is asked."""

    def __init__(self, epochs: EpochShelf, gate: QueryGate) -> None:
        self._epochs = epochs
        self._gate = gate

    @contextmanager
    def view(self, number: int) -> Iterator[Epoch]:
        """The epoch of that number, or the newest for 0."""
        with self._gate.query():
            yield self._epochs.get(number)


class Resets:
    """Forgets parts of the map."""

    def __init__(self, mapper: MapperThread) -> None:
        self._mapper = mapper

    def answer(self, request: ResetRequest) -> ResetReply:
        """Forget the request's box; answered once an epoch shows it."""
        check_box(request.minimum, request.maximum)

        def reset(mapper: Mapper) -> int:
            mapper.reset(request.minimum, request.maximum)
            return mapper.publish().number

        return ResetReply(self._mapper.call(reset))
