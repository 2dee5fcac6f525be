"""Forgetting parts of the map on request."""

from triquad_format.wire.messages import ResetReply, ResetRequest

from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.mapper_thread import MapperThread
from triquad_server.mesh.request_checks import check_box


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
