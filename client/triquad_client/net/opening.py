"""Opening a connection to a server, as a program or a configuration file describes it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zenoh
from triquad_format.errors import FormatError, InvalidInputError
from triquad_format.wire import codec, keys
from triquad_format.wire.bounds import MAX_COUNT
from triquad_format.wire.endpoints import full_endpoint
from triquad_format.wire.zenoh_config import QUIET, fill, put

from triquad_client import checks
from triquad_client.errors import ConnectError, UnknownMapError
from triquad_client.net.connection import Connection
from triquad_client.net.diagnosis import why_no_link

_HERE = "127.0.0.1"

_OF_CLIENTS: Mapping[str, Any] = {
    "mode": "client",
    "connect/timeout_ms": 0,  # one attempt, not retries
    "transport/link/rx/max_message_size": codec.MAX_MESSAGE_BYTES,
}
"""The settings of Zenoh for a client, besides what a file says."""


def open_connection(
    endpoint: str | None,
    map_name: str,
    timeout_s: float,
    config: str | Path | None,
    *,
    max_download_bytes: int,
    coordinates: str,
) -> Connection:
    """Return a connection to a server; arguments and errors as of ``triquad_client.connect``."""
    timeout_s = checks.within("timeout_s", timeout_s, checks.LONGEST_S, least=0.0)
    most = checks.count("max_download_bytes", max_download_bytes, MAX_COUNT)
    local = checks.are_local(coordinates)
    where = f"with {config}" if endpoint is None and config else f"to {endpoint or _HERE}"
    try:
        keys.check_name("map", map_name)
        configured = _configuration(endpoint, timeout_s, config)
    except FormatError as error:
        raise InvalidInputError(str(error)) from error
    except zenoh.ZError as error:
        raise ConnectError(f"cannot connect {where}: {_reason(error)}") from error
    try:
        session = zenoh.open(configured)
    except zenoh.ZError as error:
        why = why_no_link(configured, timeout_s) or (
            f"{_reason(error)} Start triquad-server there, or check the endpoint and the "
            "credentials."
        )
        raise ConnectError(f"cannot connect {where}: {why}") from error
    connection = Connection(session, map_name, timeout_s, max_download_bytes=most, local=local)
    try:
        # Asked for by name first: there may be any number of others.
        if not connection.maps(map_name):
            raise UnknownMapError(map_name, connection.maps())
    except BaseException:
        connection.close()
        raise
    return connection


def _configuration(endpoint: str | None, timeout_s: float, file: str | Path | None) -> zenoh.Config:
    config = zenoh.Config() if file is None else _read_configuration(file)
    fill(config, {**QUIET, **_OF_CLIENTS}, unset=zenoh.Config())
    put(config, {"transport/unicast/open_timeout": int(timeout_s * 1000)})
    if endpoint is not None or not json.loads(config.get_json("connect/endpoints")):
        only_tls = json.loads(config.get_json("transport/link/protocols")) == ["tls"]
        protocol = "tls" if only_tls else "tcp"
        full = full_endpoint(_HERE if endpoint is None else endpoint, protocol)
        put(config, {"connect/endpoints": [full]})
    return config


def _read_configuration(file: str | Path) -> zenoh.Config:
    try:
        config: zenoh.Config = zenoh.Config.from_file(str(file))
    except zenoh.ZError as error:
        raise ConnectError(f"Zenoh configuration {file}: {_reason(error)}") from error
    return config


def _reason(error: zenoh.ZError) -> str:
    """Return what Zenoh says, on one line, without where in Zenoh it happened."""
    return " ".join(str(error).split(" at /", 1)[0].split())
