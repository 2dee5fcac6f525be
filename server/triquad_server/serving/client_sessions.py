"""The client sessions that are linked to the server, and the session of each request."""

import secrets
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

import zenoh
from triquad_format.wire.messages import RequestOrigin, read_origin

from triquad_server.fair_queue import Owner

_UNLINKED = ""
"""The group of all clients that are not linked to the server itself: they take one turn together,
since any name can be invented."""

_GRACE_S = 0.5  # a request is handled for this much longer: its client's own time-out comes first
_REMEMBERED = 1024  # sessions that have left


@dataclass(frozen=True)
class Source:
    """The owner of a request, and the time until which its answer is waited for."""

    owner: Owner
    deadline_s: float  # monotonic


class ClientSessions:
    """Finds the session of a request; safe for any thread.

    A client that is linked and names itself has turns of its own. Those that come through a
    router, or give no name, share turns: Zenoh does not show from which link a request
    came, but invented names are no links.
    """

    def __init__(self, session: zenoh.Session) -> None:
        """Begin to watch the links of ``session``."""
        self._info = session.info
        self.own_name = secrets.token_hex(16)  # in requests of the server to itself; known to none
        self._lock = threading.Lock()
        self._links: dict[str, int] = {}  # transports by the Zenoh id at their other end
        self._left: OrderedDict[str, None] = OrderedDict()  # ids of sessions, latest last
        self._listener = self._info.declare_transport_events_listener(
            zenoh.handlers.Callback(self._count, indirect=False), history=True
        )

    def close(self) -> None:
        """End watching."""
        self._listener.undeclare()

    def source(self, query: zenoh.Query, longest_s: float) -> Source:
        """Return a request's owner and deadline; no longer wait than ``longest_s`` is believed."""
        attachment = query.attachment
        origin = None if attachment is None else read_origin(attachment.to_bytes())
        now = time.monotonic()
        if origin is None:
            return Source(Owner(_UNLINKED), now + longest_s)
        # Written so that NaN counts as not given.
        wait_s = origin.timeout_s if 0 <= origin.timeout_s <= longest_s else longest_s
        return Source(self._owner(origin), now + wait_s + _GRACE_S)

    def have_left(self, owner: Owner) -> bool:
        """Return whether the link to the client that sent a request is closed.

        A request may arrive before its link is known: a link that never was does not count.
        """
        return owner.name in self._left

    def _owner(self, origin: RequestOrigin) -> Owner:
        name = origin.client
        # A new client may send requests before its link is known here: Zenoh knows it.
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
