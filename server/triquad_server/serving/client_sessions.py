"""The client sessions that are linked to the server, and of which of them a request is."""

import secrets
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

import zenoh
from triquad_format.wire.origin import RequestOrigin, read_origin

from triquad_server.fair_queue import Owner

_UNLINKED = ""
"""The group of all clients that are not linked to the server itself: they take one turn together,
since any name can be invented."""

_GRACE_S = 0.5  # that a request is worked at for longer: its client's own time-out comes first
_REMEMBERED = 1024  # sessions that have left


@dataclass(frozen=True)
class Source:
    """Whose request it is, and until when its answer is waited for."""

    owner: Owner
    deadline_s: float  # monotonic


class ClientSessions:
    """Tells of which session a request is; safe for any thread.

    A client that is linked and says who it is has turns of its own. One that comes through a
    router, or says nothing, shares those of all such: Zenoh does not tell from which link a request
    came, but invented names are no links.
    """

    def __init__(self, session: zenoh.Session) -> None:
        """Begin to watch who is linked to ``session``."""
        self._info = session.info
        self.own_name = secrets.token_hex(16)  # in requests of the server to itself; known to none
        self._lock = threading.Lock()
        self._links: dict[str, int] = {}  # transports by the Zenoh id at their other end
        self._left: OrderedDict[str, None] = OrderedDict()  # ids of sessions, latest last
        self._listener = self._info.declare_transport_events_listener(
            zenoh.handlers.Callback(self._count, indirect=False), history=True
        )

    def close(self) -> None:
        """Watch no more."""
        self._listener.undeclare()

    def source(self, query: zenoh.Query, longest_s: float) -> Source:
        """Whose request it is; no client is believed to wait for more than ``longest_s``."""
        attachment = query.attachment
        origin = None if attachment is None else read_origin(attachment.to_bytes())
        now = time.monotonic()
        if origin is None:
            return Source(Owner(_UNLINKED), now + longest_s)
        # Written so that NaN counts as not given.
        wait_s = origin.timeout_s if 0 <= origin.timeout_s <= longest_s else longest_s
        return Source(self._owner(origin), now + wait_s + _GRACE_S)

    def have_left(self, owner: Owner) -> bool:
        """Whether the link to the client that a request is of is closed.

        A request may arrive before its link is known: a link that never was counts for nothing.
        """
        return owner.name in self._left

    def _owner(self, origin: RequestOrigin) -> Owner:
        name = origin.client
        # One that is new may ask before its link is known here: Zenoh knows.
        is_known = (
            name == self.own_name
            or name in self._links
            or any(str(transport.zid) == name for transport in self._info.transports())
        )
        return Owner(name if is_known else _UNLINKED, name)

    def _count(self, event: zenoh.TransportEvent) -> None:
        client = str(event.transport.zid)
        with self._lock:
            count = self._links.get(client, 0) + (1 if event.kind == zenoh.SampleKind.PUT else -1)
            if count > 0:
                self._links[client] = count
                self._left.pop(client, None)
            else:
                self._links.pop(client, None)
                self._left[client] = None
                while len(self._left) > _REMEMBERED:
                    self._left.popitem(last=False)
