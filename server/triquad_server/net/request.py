"""One request: its Zenoh query, answered exactly once."""

import logging
from collections.abc import Callable
from typing import TypeVar

import zenoh
from triquad_format.errors import ProtocolVersionError, RefusedError, WireError
from triquad_format.wire import codec, keys
from triquad_format.wire.codec import Message
from triquad_format.wire.messages import ErrorReply

from triquad_server.counter import Counter

_log = logging.getLogger(__name__)

RequestT = TypeVar("RequestT", bound=Message)

_POINT_BYTES = 12
_OTHER_BYTES = 4096  # the largest message takes less without its points


def payload_limit(points: int) -> int:
    """Most bytes that a message of so many points may have: what is larger is not decoded."""
    return points * _POINT_BYTES + _OTHER_BYTES


class Request:
    """A query that waits for its answer."""

    def __init__(self, query: zenoh.Query, key: str, refused: Counter) -> None:
        """``key`` is the key of the operation; refusals are counted in ``refused``."""
        self._query = query
        self._key = key
        self._refused = refused

    @property
    def size(self) -> int:
        """Bytes of the payload."""
        payload = self._query.payload
        return 0 if payload is None else len(payload)

    def read(self, kind: type[RequestT]) -> RequestT:
        """The request's message.

        Raises:
            RefusedError: there is none, or it cannot be decoded.
        """
        payload = self._query.payload
        if payload is None:
            raise RefusedError("bad_request", f"no payload: expected a {kind.__name__}")
        try:
            return codec.decode(kind, payload.to_bytes())
        except ProtocolVersionError as error:
            raise RefusedError("bad_version", str(error)) from error
        except WireError as error:
            raise RefusedError("bad_request", str(error)) from error

    def answer(self, message: Message) -> None:
        """Reply with ``message``."""
        payload = codec.encode(message)
        self._finish(
            lambda: self._query.reply(self._key, payload, encoding=keys.encoding(type(message))),
        )

    def refuse(self, code: str, text: str) -> None:
        """Reply with an error; ``code`` is one of ``ERROR_CODES``."""
        self._refused.add(code)
        _log.debug("request on %s refused (%s): %s", self._key, code, text)
        payload = codec.encode(ErrorReply(code, text[:4096]))
        self._finish(lambda: self._query.reply_err(payload, encoding=keys.encoding(ErrorReply)))

    def _finish(self, reply: Callable[[], None]) -> None:
        """Send the reply and end the query, also where the one who asked is gone."""
        try:
            with self._query:
                reply()
        except zenoh.ZError as error:
            _log.warning("no answer could be sent on %s: %s", self._key, error)
