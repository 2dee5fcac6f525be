"""Where the server listens, as a Zenoh configuration."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import zenoh
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT

from triquad_server.errors import ListenError, ServerError

_CONNECT_MS = 5000  # a router that was started together with the server may need a moment

_ZENOH_THREADS = "(rx: (worker_threads: 4), tx: (worker_threads: 8))"
"""Of Zenoh's threads, as its environment variable ``ZENOH_RUNTIME`` has them.

Zenoh gives up a client that takes nothing after five seconds, and the thread that sends to it then
waits for whoever else has something for it. By default all clients share one such thread: replies
to others were late as well, and their links were closed in turn. Those that receive are more than
the usual two for the same reason: many megabytes of one client must not come before all others.
"""


@dataclass(frozen=True)
class NetworkOptions:
    """Options that are given to the Zenoh session; ``None`` leaves the file's value."""

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    mode: str | None = None
    config_file: Path | None = None
    multicast_scouting: bool | None = None


def open_session(options: NetworkOptions) -> zenoh.Session:
    """An open Zenoh session.

    Raises:
        ServerError: the configuration is not valid.
        ListenError: an endpoint cannot be listened on, or none to connect to answers.
    """
    try:
        config = _configuration(options)
    except (zenoh.ZError, ValueError, OSError) as error:
        raise ServerError(f"Zenoh configuration: {_first_line(error)}") from error
    os.environ.setdefault("ZENOH_RUNTIME", _ZENOH_THREADS)  # read once, by the first session
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ListenError(_what_failed(options, _first_line(error))) from error


def _what_failed(options: NetworkOptions, reason: str) -> str:
    if reason.startswith("Unable to connect"):
        endpoints = ", ".join(options.connect) or "the configured endpoints"
        return f"cannot connect to {endpoints}: {reason} Start a router there first."
    endpoints = ", ".join(listen_endpoints(options)) or "the configured endpoints"
    return (
        f"cannot open {endpoints}: {reason} (is another server running there? "
        "choose another endpoint with --listen)"
    )


def listen_endpoints(options: NetworkOptions) -> tuple[str, ...]:
    """The endpoints given, or the default; () where the file decides, or a client."""
    if options.listen or options.config_file is not None or options.mode == "client":
        return options.listen
    return (DEFAULT_ENDPOINT,)


def _configuration(options: NetworkOptions) -> zenoh.Config:
    if options.config_file is not None:
        config: zenoh.Config = zenoh.Config.from_file(str(options.config_file))
    else:
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        # Samples in shared memory are lost without notice where the receiver is descheduled for
        # a tenth of a second, which training does to it.
        config.insert_json5("transport/shared_memory/enabled", "false")
    listen = listen_endpoints(options)
    if listen:
        config.insert_json5("listen/endpoints", json.dumps(listen))
        config.insert_json5("listen/exit_on_failure", "true")
    if options.connect:
        config.insert_json5("connect/endpoints", json.dumps(options.connect))
        # By default a router goes on without, and says nothing.
        config.insert_json5("connect/timeout_ms", str(_CONNECT_MS))
        config.insert_json5("connect/exit_on_failure", "true")
    if options.mode is not None:
        config.insert_json5("mode", json.dumps(options.mode))
    if options.multicast_scouting is not None:
        config.insert_json5("scouting/multicast/enabled", json.dumps(options.multicast_scouting))
    return config


def _first_line(error: Exception) -> str:
    """The text of an error without Zenoh's source locations."""
    return str(error).split(" at /", 1)[0].strip()
