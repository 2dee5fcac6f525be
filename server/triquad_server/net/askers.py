"""Who asks: of which of the linked sessions a request is, and whether others ask as well."""

import math
import secrets
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass

import zenoh
from triquad_format.wire.origin import RequestOrigin, read_origin

from triquad_server.fair_queue import Owner

_UNLINKED = ""
"""The group of all who are not linked to the server itself: they take one turn together, since
any name can be invented."""

_LATELY_S = 1.0
_GRACE_S = 0.5  # a client's own time-out comes first
_EVENTS = 1024  # that wait to be heard of
_GONE = 1024  # sessions that were linked and are not any more, of which is known


@dataclass(frozen=True)
class Asker:
    """Who asked, and until when the answer is waited for."""

    owner: Owner  # of the request
    deadline_s: float  # monotonic


class Askers:
    """Tells who asks; safe for any thread.

    A client that is linked and says who it is has a turn of its own. One that comes through a
    router, or says nothing, shares one with all such: Zenoh does not tell from which link a request
    came, but invented names are no links.
    """

    def __init__(self, session: zenoh.Session) -> None:
        """Begin to watch who is linked to ``session``."""
        self._info = session.info
        self.own_name = secrets.token_hex(16)  # in what the server asks itself, and known to none
        self._lock = threading.Lock()
        self._latest = Owner(_UNLINKED)  # who was heard of
        self._others_s = -math.inf  # when it last was another one, monotonic
        self._links: dict[str, int] = {}  # transports by the Zenoh id at their other end
        self._gone: OrderedDict[str, None] = OrderedDict()  # ids of sessions, latest last
        self._listener = session.info.declare_transport_events_listener(
            zenoh.handlers.FifoChannel(_EVENTS), history=True
        )
        self._thread = threading.Thread(target=self._watch, name="links")
        self._thread.start()

    def close(self) -> None:
        """Watch no more."""
        self._listener.undeclare()
        self._thread.join()

    @property
    def are_several(self) -> bool:
        """Whether more than one was heard of lately: who asks much then leaves time to others."""
        return time.monotonic() - self._others_s < _LATELY_S

    def asker(self, query: zenoh.Query, longest_s: float) -> Asker:
        """Who asks; nobody is believed to wait for more than ``longest_s``."""
        asker = self._identify(_origin(query), longest_s)
        self.hear_of(asker)
        return asker

    def hear_of(self, asker: Asker) -> None:
        """Somebody asks, or what somebody asked is worked at."""
        with self._lock:
            if asker.owner != self._latest:
                self._latest, self._others_s = asker.owner, time.monotonic()

    def has_left(self, asker: Asker) -> bool:
        """Whether the link to one who asked is gone.

        A request may be heard of before its link is, so that what it was then does not count.
        """
        return asker.owner.name in self._gone

    def _identify(self, origin: RequestOrigin | None, longest_s: float) -> Asker:
        now = time.monotonic()
        if origin is None:
            return Asker(Owner(_UNLINKED), deadline_s=now + longest_s)
        # Written so that NaN counts as not given.
        wait_s = origin.timeout_s if 0 <= origin.timeout_s <= longest_s else longest_s
        is_known = origin.client == self.own_name or self._is_linked(origin.client)
        group = origin.client if is_known else _UNLINKED
        return Asker(Owner(group, origin.client), deadline_s=now + wait_s + _GRACE_S)

    def _is_linked(self, client: str) -> bool:
        """Whether a client is linked to the session.

        One that is new may ask before its link was heard of: Zenoh knows. In the group of those who
        are not linked it might wait for all that others sent under invented names.
        """
        return client in self._links or any(
            str(transport.zid) == client for transport in self._info.transports()
        )

    def _watch(self) -> None:
        for event in self._listener:
            client = str(event.transport.zid)
            count = self._links.get(client, 0) + (1 if event.kind == zenoh.SampleKind.PUT else -1)
            if count > 0:
                self._links[client] = count
                self._gone.pop(client, None)
            else:
                self._links.pop(client, None)
                self._gone[client] = None
                while len(self._gone) > _GONE:
                    self._gone.popitem(last=False)


def _origin(query: zenoh.Query) -> RequestOrigin | None:
    attachment = query.attachment
    return None if attachment is None else read_origin(attachment.to_bytes())
