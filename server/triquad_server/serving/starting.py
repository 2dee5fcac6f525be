"""Answers while a server starts: each question is refused with what it is about to do."""

import zenoh
from triquad_format.wire import codec, keys
from triquad_format.wire.messages import ErrorReply


class StartingNotice:
    """Tells clients, until it is closed, that the server of a map is there but not ready."""

    def __init__(self, session: zenoh.Session, map_name: str) -> None:
        """Begin to refuse questions."""
        self.stage = "it has just begun"
        # Zenoh's own thread answers: the others may be compiling.
        self._queryable = session.declare_queryable(
            keys.all_queries_key(map_name), zenoh.handlers.Callback(self._refuse, indirect=False)
        )

    def close(self) -> None:
        """Refuse no more."""
        self._queryable.undeclare()

    def _refuse(self, query: zenoh.Query) -> None:
        reply = codec.encode(ErrorReply("starting", self.stage))
        with query:
            query.reply_err(reply, encoding=keys.encoding(ErrorReply))
