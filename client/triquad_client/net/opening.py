"""Opening a connection to a server, as a program or a configuration file describes it."""

import json
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zenoh
from triquad_format.errors import FormatError, InvalidInputError
from triquad_format.wire import codec, keys
from triquad_format.wire.bounds import MAX_COUNT
from triquad_format.wire.endpoints import full_endpoint
from triquad_format.wire.shares import number_of_share
from triquad_format.wire.zenoh_config import QUIET, fill, put, reason

from triquad_client import checks
from triquad_client.errors import ConnectError, UnknownMapError
from triquad_client.net.connection import Connection
from triquad_client.net.diagnosis import REMEDY, Obstacle, why_no_link
from triquad_client.net.shared_connection import SharedConnection

_log = logging.getLogger("triquad_client")

_HERE = "127.0.0.1"
_PAUSE_S = 0.1  # between two attempts
_TOLD_AFTER_S = 3.0  # most servers are ready by then
_USUAL_S = 10.0
_START_S = 600.0  # for a server that says that it starts: it compiles, or opens a large map

_OF_CLIENTS: Mapping[str, Any] = {
    "mode": "client",
    "connect/timeout_ms": 0,  # one attempt, not retries
    "transport/link/rx/max_message_size": codec.MAX_MESSAGE_BYTES,
}
"""The settings of Zenoh for a client, besides what a file says."""


def open_connection(
    endpoint: str | None,
    map_name: str,
    timeout_s: float | None,
    config: str | Path | None,
    *,
    max_download_bytes: int,
    coordinates: str,
) -> Connection:
    """Return a connection to a server; arguments and errors as of ``triquad_client.connect``."""
    start_s = _START_S if timeout_s is None else 0.0
    given_s = _USUAL_S if timeout_s is None else timeout_s
    timeout_s = checks.within("timeout_s", given_s, checks.LONGEST_S, least=checks.SHORTEST_S)
    most = checks.count("max_download_bytes", max_download_bytes, MAX_COUNT)
    local = checks.are_local(coordinates)
    where = f"with {config}" if endpoint is None and config else f"to {endpoint or _HERE}"
    try:
        keys.check_name("map", map_name)
        configured = _configuration(endpoint, timeout_s, config)
    except FormatError as error:
        raise InvalidInputError(str(error)) from error
    except zenoh.ZError as error:
        raise ConnectError(f"cannot connect {where}: {reason(error)}") from error
    patience = _Patience(timeout_s)
    session = _open(configured, where, patience)
    connection = Connection(
        session, map_name, timeout_s, max_download_bytes=most, local=local, where=where
    )
    try:
        names = _servers_of_map(connection, patience, start_s)
        numbers = frozenset(filter(None, (number_of_share(map_name, name) for name in names)))
        return SharedConnection(connection, numbers) if numbers else connection
    except BaseException:
        connection.close()
        raise


class _Patience:
    """The wait for a server that is not there yet, or still starts."""

    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        self._began_s = time.monotonic()
        self._told = ""

    def wait(self, why: str, least_s: float = 0.0) -> bool:
        """Wait a moment, and say ``why`` after a while; return False where it was long enough."""
        waited_s, longest_s = time.monotonic() - self._began_s, max(self.timeout_s, least_s)
        if waited_s >= longest_s:
            return False
        if waited_s > _TOLD_AFTER_S and why != self._told:
            self._told = why
            _log.warning("%s; waiting for %g s at most", why, longest_s)
        time.sleep(_PAUSE_S)
        return True


def _open(configured: zenoh.Config, where: str, patience: _Patience) -> zenoh.Session:
    """Open a session, once something listens.

    Raises:
        ConnectError: nothing does, or it does not let us in.
    """
    while True:
        try:
            return zenoh.open(configured)
        except zenoh.ZError as error:
            obstacle = why_no_link(configured, patience.timeout_s) or Obstacle(
                f"{reason(error)} Start triquad-server there, or check the endpoint and the "
                "credentials."
            )
            told, remedy = f"cannot connect {where}: {obstacle.why}", ""
            if obstacle.may_pass:
                if patience.wait(told):
                    continue
                remedy = REMEDY
            raise ConnectError(told + remedy) from error


def _servers_of_map(connection: Connection, patience: _Patience, start_s: float) -> list[str]:
    """Return the servers of the map, once one is ready; it may take ``start_s`` to start.

    Raises:
        UnknownMapError: there is none.
        ConnectError: it is still starting.
    """
    name = connection.map_name
    # Asked for by name first: there may be any number of others.
    while not (found := connection.servers(name)):
        stage = connection.start_stage()
        if stage is not None:
            told = f"the server of map {name!r} is starting: {stage}"
            if not patience.wait(told, start_s):
                raise ConnectError(f"{told}; connect again, or with a longer timeout_s")
            continue
        there = connection.maps()
        # It, or a server that shares it, may have come since it was asked for.
        has_it = any(other == name or number_of_share(name, other) is not None for other in there)
        has_others = bool(there) and not has_it
        if has_others or not patience.wait(f"no server has a map {name!r} yet"):
            raise UnknownMapError(name, there)
    return [server for _, server in found]


def _configuration(endpoint: str | None, timeout_s: float, file: str | Path | None) -> zenoh.Config:
    config = zenoh.Config() if file is None else _read_configuration(file)
    fill(config, {**QUIET, **_OF_CLIENTS}, unset=zenoh.Config())
    put(config, {"transport/unicast/open_timeout": int(timeout_s * 1000)})
    if endpoint is not None or not json.loads(config.get_json("connect/endpoints")):
        only_tls = json.loads(config.get_json("transport/link/protocols")) == ["tls"]
        protocol = "tls" if only_tls else "tcp"
        several = (_HERE if endpoint is None else endpoint).split(",")
        full = [full_endpoint(one.strip(), protocol) for one in several]
        put(config, {"connect/endpoints": full})
    return config


def _read_configuration(file: str | Path) -> zenoh.Config:
    try:
        config: zenoh.Config = zenoh.Config.from_file(str(file))
    except zenoh.ZError as error:
        raise ConnectError(f"Zenoh configuration {file}: {reason(error)}") from error
    return config
