"""Who may reach the page: those who opened it, and no page of somebody else in their browser.

A browser lets any page send requests to this machine. It says in ``Origin`` whose page asks, and in
``Host`` under which name: a name that is not ours was made to point here.
"""

import http
import ipaddress
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

_Answer = Callable[[Any, Request], Any]

_patching = threading.Lock()


class Visitors:
    """Tells which requests are answered."""

    def __init__(self, allowed_hosts: Sequence[str] = ()) -> None:
        """``allowed_hosts`` are names of this machine beyond its addresses and its host name."""
        self._given = frozenset(host.lower() for host in allowed_hosts)
        name = socket.gethostname().lower()
        self._own = self._given | {"localhost", name, f"{name}.local"}

    def refusal(self, headers: Headers) -> str | None:
        """Why a request is not answered, or ``None``."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(_name(hosts[0])):
            return "this page is not served under that name: triquad-view --allow-host NAME"
        if any(not self._is_same(origin, hosts[0]) for origin in origins):
            return "another page may not use this one: triquad-view --allow-host NAME of its host"
        return None

    def _is_own(self, name: str) -> bool:
        """Whether nobody else can have made a name point here: addresses cannot be made to."""
        return name in self._own or _is_address(name)

    def _is_same(self, origin: str, host: str) -> bool:
        """Whether a page from ``origin`` is the one that is served as ``host``."""
        place = urlsplit(origin).netloc.lower()
        return place == host.lower() or _name(place) in self._given


@contextmanager
def serving_only(visitors: Visitors) -> Iterator[None]:
    """Servers of websockets that are started meanwhile answer these visitors alone.

    The viewer's library starts its server where no option reaches it.
    """
    serve = websockets.asyncio.server.serve

    def guarded(*arguments: Any, process_request: _Answer, **options: Any) -> Any:
        return serve(*arguments, process_request=_guard(visitors, process_request), **options)

    with _patching:
        websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _guard(visitors: Visitors, answer: _Answer) -> _Answer:
    def answer_visitor(connection: Any, request: Request) -> Any:
        reason = visitors.refusal(request.headers)
        if reason is not None:
            forbidden = http.HTTPStatus.FORBIDDEN
            body = f"{reason}\n".encode()
            headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
            return Response(forbidden, forbidden.phrase, headers, body)
        return answer(connection, request)

    return answer_visitor


def _name(host: str) -> str:
    """The name or address in a ``Host`` header, without its port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
