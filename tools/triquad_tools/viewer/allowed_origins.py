"""The requests that the page answers: its own, and those of no other page in the browser.

A browser lets any page send requests to this machine. Its ``Origin`` says whose page asks, its
``Host`` under which name: a name that is not ours was made to point here.
"""

import http
import ipaddress
import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

_log = logging.getLogger(f"{__name__}.websockets")
# Browsers leave before they have said what they want, which is no error of ours.
_log.addFilter(lambda record: record.getMessage() != "opening handshake failed")


def refusal(headers: Headers, allowed_hosts: Sequence[str]) -> str | None:
    """Return why a request is not answered, or ``None``.

    ``allowed_hosts`` are names of this machine beyond its addresses and its host name.
    """
    given, here = {host.lower() for host in allowed_hosts}, socket.gethostname().lower()
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    name = _name(hosts[0]) if len(hosts) == 1 else ""
    # Addresses cannot be made to point here by others.
    if name not in given | {"localhost", here, f"{here}.local"} and not _is_address(name):
        return "this page is not served under that name: triquad-view --allow-host NAME"
    for origin in origins:
        place = urlsplit(origin).netloc.lower()
        if place != hosts[0].lower() and _name(place) not in given:
            return "another page may not use this one: triquad-view --allow-host its NAME"
    return None


@contextmanager
def serving_only(allowed_hosts: Sequence[str]) -> Iterator[None]:
    """Let servers of websockets that are started meanwhile refuse what :func:`refusal` names.

    The viewer's library starts its server where no option reaches it.
    """
    serve = websockets.asyncio.server.serve

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer_allowed(connection: Any, request: Request) -> Any:
            reason = refusal(request.headers, allowed_hosts)
            if reason is None:
                return process_request(connection, request)
            forbidden, body = http.HTTPStatus.FORBIDDEN, f"{reason}\n".encode()
            headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(body))})
            return Response(forbidden, forbidden.phrase, headers, body)

        return serve(*arguments, process_request=answer_allowed, logger=_log, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _name(host: str) -> str:
    """Return the name or address in a ``Host`` header, without its port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False
