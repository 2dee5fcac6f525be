"""The Zenoh session of a server."""

import os

import zenoh

from triquad_server.errors import ListenError
from triquad_server.net.configuration import Configuration, first_line

_ZENOH_THREADS = "(rx: (worker_threads: 4), tx: (worker_threads: 8))"
"""The number of Zenoh's threads, in the form of its environment variable ``ZENOH_RUNTIME``.

Zenoh gives up a client that takes nothing after five seconds, and the thread that sends to it then
waits for any others that have something for it. By default all clients share one such thread:
replies to others were late as well, and their links were closed in turn. Those that receive are
more than the usual two for the same reason: many megabytes of one client must not come before all
others.
"""


def open_session(config: Configuration) -> zenoh.Session:
    """Open a Zenoh session.

    Raises:
        ListenError: an endpoint cannot be listened on, or none to connect to answers.
    """
    os.environ.setdefault("ZENOH_RUNTIME", _ZENOH_THREADS)  # read once, by the first session
    try:
        return zenoh.open(config.zenoh)
    except zenoh.ZError as error:
        raise ListenError(_what_failed(config, first_line(error))) from error


def _what_failed(config: Configuration, reason: str) -> str:
    if reason.startswith("Unable to connect"):
        endpoints = ", ".join(config.connect)
        return f"cannot connect to {endpoints}: {reason} Start a router there first."
    remedy = "is another server running there? choose another endpoint with --listen"
    if "TLS" in reason and "in use" not in reason:
        remedy = "check the credentials of the Zenoh configuration: triquad-keys makes them"
    elif "not supported" in reason:
        remedy = "write --listen tcp/HOST:PORT"
    elif "lookup address" in reason:
        remedy = "give --listen an address of this machine, or 0.0.0.0 for all of them"
    return f"cannot open {', '.join(config.listen)}: {reason} ({remedy})"
