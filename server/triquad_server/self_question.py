"""A query that the server sends to itself, to check that it still answers."""

import numpy as np
import zenoh
from triquad_format.errors import WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply, RequestOrigin, SdfRequest


class SelfQuestion:
    """Queries the field at one point, in the same way as clients do."""

    def __init__(self, session: zenoh.Session, map_name: str, own_name: str) -> None:
        """Make the query; ``own_name`` has its own turns, as any client: none comes before."""
        self._session = session
        self._key = keys.operation_key(map_name, keys.SDF)
        request = SdfRequest(np.zeros(3), np.zeros((1, 3), np.float32), gradient=False, epoch=0)
        self._payload = codec.encode(request)
        self._own_name = own_name

    def problem(self, timeout_s: float) -> str | None:
        """Return an error if no answer came in time; ``None`` if one came.

        A refusal, where too many requests wait, is an answer.
        """
        replies = self._session.get(
            self._key,
            payload=self._payload,
            attachment=codec.encode(RequestOrigin(self._own_name, timeout_s)),
            timeout=timeout_s,
            allowed_destination=zenoh.Locality.SESSION_LOCAL,
        )
        if any(reply.err is None or _is_ours(reply.err) for reply in replies):
            return None
        return f"a question that the server asked itself got no answer within {timeout_s:g} s"


def _is_ours(error: zenoh.ReplyError) -> bool:
    """Return whether an error comes from the server, not from Zenoh, whose wait has ended."""
    try:
        codec.decode(ErrorReply, error.payload.to_bytes())
    except WireError:
        return False
    return True
