"""The reason why no link came about, and what to do; Zenoh itself names the endpoint alone."""

import base64
import json
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import zenoh
from triquad_format.wire.endpoints import Locator

_PROTOCOLS = ("tcp", "tls", "udp", "quic", "ws", "serial", "vsock", "unixsock-stream", "unixpipe")
_LONGEST_S = 1.0  # for each attempt
REMEDY = ". Start triquad-server there, or check the endpoint"

_FILES = ("root_ca_certificate", "connect_certificate", "connect_private_key")

_OTHER_AUTHORITY = (
    " (it is not of the authority that the configuration trusts: connect with the file of a role "
    "that triquad-keys made for this server)"
)
_OTHER_HOST = " (connect by a host that was given to triquad-keys init --host)"
_HINTS = {
    10: " (triquad-keys renew makes a new one)",
    **dict.fromkeys((18, 19, 20), _OTHER_AUTHORITY),
    **dict.fromkeys((62, 64), _OTHER_HOST),
}
"""The advice on what to do, by the codes of OpenSSL."""


class Obstacle(NamedTuple):
    """What stands in the way of a link."""

    why: str
    may_pass: bool = False  # it goes away by itself where a server is just being started


def why_no_link(config: zenoh.Config, timeout_s: float) -> Obstacle | None:
    """Return what stands in the way of a link with ``config``, where that can be known."""
    found = [Obstacle(why) for why in _of_files(config)]
    may_pass = not found
    for endpoint in _endpoints(config):
        obstacle = _of_endpoint(endpoint, config, max(0.01, min(timeout_s, _LONGEST_S)))
        if obstacle is not None:
            found.append(obstacle)
    if not found:
        return None
    may_pass = may_pass and any(obstacle.may_pass for obstacle in found)
    return Obstacle("; ".join(obstacle.why for obstacle in found), may_pass)


def _endpoints(config: zenoh.Config) -> list[str]:
    endpoints = json.loads(config.get_json("connect/endpoints"))
    if isinstance(endpoints, dict):
        endpoints = endpoints.get("client") or []
    return [endpoint for endpoint in endpoints if isinstance(endpoint, str)]


def _of_files(config: zenoh.Config) -> Iterator[str]:
    """Yield credentials that cannot be read."""
    for name in _FILES:
        path = _tls(config, name)
        if path is None:
            continue
        try:
            with Path(path).open("rb"):
                pass
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            yield f"the configuration names {path} as its {name}: {why}"


def _of_endpoint(endpoint: str, config: zenoh.Config, timeout_s: float) -> Obstacle | None:
    protocol, host, port = Locator.of(endpoint)
    if protocol not in _PROTOCOLS:
        return Obstacle(
            f"{protocol!r} is no protocol of Zenoh: use tcp/HOST:PORT, or tls/HOST:PORT"
        )
    host = host.removeprefix("[").removesuffix("]")
    if protocol not in ("tcp", "tls") or not host or not (port.isascii() and port.isdigit()):
        return None
    try:
        with socket.create_connection((host, int(port)), timeout_s) as link:
            link.settimeout(timeout_s)
            return Obstacle(_of_tls(link, host, config)) if protocol == "tls" else _of_tcp(link)
    except socket.gaierror:
        return Obstacle(f"no address is known of the host {host!r}{REMEDY}")
    except ConnectionRefusedError:
        return Obstacle(f"nothing listens at {host} on port {port}", may_pass=True)
    except TimeoutError:
        return Obstacle(f"{host} does not answer on port {port}", may_pass=True)
    except (OSError, OverflowError, UnicodeError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        return Obstacle(f"{host}, port {port}: {why}{REMEDY}")


def _of_tcp(link: socket.socket) -> Obstacle:
    """Return why something that listens lets no link by plain TCP come about."""
    if _speaks_tls(link):
        return Obstacle(
            "the server wants an encrypted link and a certificate: connect with the file of a "
            "role, such as config='robot.json5' or --config robot.json5 (docs/security.md)"
        )
    return Obstacle("something listens there, but no link came about", may_pass=True)


def _speaks_tls(link: socket.socket) -> bool:
    """Return whether the other side speaks TLS. Nothing is sent: it does not matter who it is."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with context.wrap_socket(link):
            return True
    except OSError:  # among them what ssl raises
        return False


def _of_tls(link: socket.socket, host: str, config: zenoh.Config) -> str:
    """Return why something that listens lets no link by TLS come about."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = _tls(config, "verify_name_on_connect") is not False
    try:
        _trust_authority(context, config)
        with context.wrap_socket(link, server_hostname=host):
            pass
    except ssl.SSLCertVerificationError as error:
        why = error.verify_message.removesuffix(".") + _HINTS.get(error.verify_code, "")
        return f"the certificate of what listens there is not accepted: {why}"
    except (OSError, ValueError):  # among them what ssl raises
        return "what listens there did not answer by TLS as a server of the same authority would"
    if not any(_tls(config, key) for key in ("connect_certificate", "connect_certificate_base64")):
        return (
            "the server may want a certificate: connect with the file of a role, such as "
            "config='robot.json5' or --config robot.json5 (docs/security.md)"
        )
    return (
        "the server does not take the certificate of this configuration: it may have expired, or "
        "be of another authority"
    )


def _trust_authority(context: ssl.SSLContext, config: zenoh.Config) -> None:
    """Trust whom the configuration trusts, and where it says nothing, whom the system does."""
    path, text = _tls(config, "root_ca_certificate"), _tls(config, "root_ca_certificate_base64")
    if path is not None:
        context.load_verify_locations(cafile=path)
    elif text is not None:
        context.load_verify_locations(cadata=base64.b64decode(text).decode("ascii"))
    else:
        context.load_default_certs()


def _tls(config: zenoh.Config, key: str) -> Any:
    """Return a value of the configuration; ``None`` where it has none."""
    return json.loads(config.get_json(f"transport/link/tls/{key}"))
