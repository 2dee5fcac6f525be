"""The Zenoh session of a server. Of its configuration options come first, then a file, then safe
defaults."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT, is_of_this_machine
from triquad_format.wire.limits import MAX_QUERY_POINTS, payload_limit
from triquad_format.wire.zenoh_access import access_control, without_credentials
from triquad_format.wire.zenoh_config import QUIET, fill, is_set, put, reason

from triquad_server.errors import ListenError, ServerError
from triquad_server.settings import Settings

_CONNECT_MS = 5000  # a router that was started together with the server may need a moment

_ONE_TRY_MS = 1000  # others of a shared map may come later: it is tried again all the time

_LINKS: Mapping[str, Any] = {
    # A link that is opened and then sends nothing takes up one of the pending places.
    "transport/unicast/accept_timeout": 5000,
    "transport/unicast/accept_pending": 1000,
    "transport/unicast/max_sessions": 500,
}

_SENSOR_POINT_BYTES = 64
"""The bytes of a point with all fields of lidar drivers, in messages for which a server is only the
router."""

_NO_SCOUTING = {"scouting/delay": 1}
"""How long a router waits for others as it starts [ms], 500 by default; without scouting, none
come."""

_ZENOH_THREADS = "(rx: (worker_threads: 4), tx: (worker_threads: 8))"
"""The number of Zenoh's threads, in the form of its environment variable ``ZENOH_RUNTIME``.

Zenoh gives up a client that takes nothing after five seconds, and the thread that sends to it then
waits for any others that have something for it. By default all clients share one such thread:
replies to others were late as well, and their links were closed in turn. Those that receive are
more than the usual two for the same reason: many megabytes of one client must not come before all
others.
"""


@dataclass(frozen=True)
class NetworkOptions:
    """Options of the Zenoh session; those that are left out are as the file has them."""

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    mode: str | None = None
    config_file: Path | None = None
    multicast_scouting: bool | None = None


@dataclass(frozen=True)
class Configuration:
    """A configuration to open a session with."""

    zenoh: zenoh.Config
    own_access_control: bool  # whether that is the server's, not that of a file

    @property
    def mode(self) -> str:
        """The mode of the session: ``router``, ``peer`` or ``client``."""
        return str(json.loads(self.zenoh.get_json("mode")))

    @property
    def listen(self) -> tuple[str, ...]:
        """The endpoints that are listened on."""
        return self._endpoints("listen/endpoints")

    @property
    def connect(self) -> tuple[str, ...]:
        """The endpoints that are connected to."""
        return self._endpoints("connect/endpoints")

    @property
    def listens_beyond(self) -> bool:
        """Return whether others than programs of this machine can connect."""
        return not all(map(is_of_this_machine, self.listen))

    def _endpoints(self, path: str) -> tuple[str, ...]:
        """Return a list of endpoints, which Zenoh lets differ by mode."""
        endpoints = json.loads(self.zenoh.get_json(path))
        if isinstance(endpoints, dict):
            endpoints = endpoints.get(self.mode) or []
        return tuple(endpoints)


def configuration(
    options: NetworkOptions, settings: Settings, *, waits: bool = True
) -> Configuration:
    """Return the configuration of a server, which ``waits`` for those that it connects to.

    What the options leave out is as the file has it; what both leave out is safe: a router
    that only this machine reaches, that neither looks for others nor is found, and that takes no
    more than it needs.

    Raises:
        ServerError: the file cannot be read, or a value is not valid.
    """
    try:
        return _configuration(options, _safe(settings), waits)
    except (zenoh.ZError, ValueError, OSError) as error:
        file = "" if options.config_file is None else f" {options.config_file}"
        raise ServerError(f"Zenoh configuration{file}: {reason(error)}") from error


def _configuration(options: NetworkOptions, safe: dict[str, Any], waits: bool) -> Configuration:
    unset = zenoh.Config()
    file = options.config_file
    config = zenoh.Config() if file is None else zenoh.Config.from_file(str(file))
    put(config, _of_options(options, waits))
    fill(config, {"mode": "router"}, unset)
    is_own = not is_set(config, "access_control", unset)
    fill(config, safe, unset)
    if not json.loads(config.get_json("scouting/multicast/enabled")):
        fill(config, _NO_SCOUTING, unset)
    found = Configuration(config, own_access_control=is_own)
    if found.mode != "client":
        fill(config, {"listen/endpoints": [DEFAULT_ENDPOINT]}, unset)
    return found


def _of_options(options: NetworkOptions, waits: bool) -> dict[str, Any]:
    given: dict[str, Any] = {}
    if options.mode is not None:
        given["mode"] = options.mode
    if options.multicast_scouting is not None:
        given["scouting/multicast/enabled"] = options.multicast_scouting
    if options.listen:
        given["listen/endpoints"] = options.listen
        given["listen/exit_on_failure"] = True
    if options.connect:
        given["connect/endpoints"] = options.connect
        # By default a router continues without, and reports nothing.
        given["connect/timeout_ms"] = _CONNECT_MS if waits else _ONE_TRY_MS
        given["connect/exit_on_failure"] = waits
    return given


def _safe(settings: Settings) -> dict[str, Any]:
    """Return what holds where neither options nor a file set something else."""
    return {
        **QUIET,
        **_LINKS,
        "transport/link/rx/max_message_size": _max_message_bytes(settings.scan.max_points),
        "access_control": access_control(without_credentials()),
    }


def _max_message_bytes(scan_points: int) -> int:
    """Return the largest message that is received at all.

    It is twice the largest that is answered: what is somewhat too large is refused with the reason,
    and only what is far beyond gets no answer.
    """
    largest = 2 * payload_limit(max(MAX_QUERY_POINTS, scan_points))
    return max(largest, payload_limit(0) + scan_points * _SENSOR_POINT_BYTES)


def open_session(config: Configuration) -> zenoh.Session:
    """Open a Zenoh session.

    Raises:
        ListenError: an endpoint cannot be listened on, or none to connect to answers.
    """
    os.environ.setdefault("ZENOH_RUNTIME", _ZENOH_THREADS)  # read once, by the first session
    try:
        return zenoh.open(config.zenoh)
    except zenoh.ZError as error:
        raise ListenError(_what_failed(config, reason(error))) from error


def _what_failed(config: Configuration, why: str) -> str:
    if why.startswith("Unable to connect"):
        endpoints = ", ".join(config.connect)
        return f"cannot connect to {endpoints}: {why} Start a router there first."
    remedy = "is another server running there? choose another endpoint with --listen"
    if "TLS" in why and "in use" not in why:
        remedy = "check the credentials of the Zenoh configuration: triquad-keys makes them"
    elif "not supported" in why:
        remedy = "write --listen tcp/HOST:PORT"
    elif "lookup address" in why:
        remedy = "give --listen an address of this machine, or 0.0.0.0 for all of them"
    return f"cannot open {', '.join(config.listen)}: {why} ({remedy})"
