"""Configurations of Zenoh, a file for each server, router and client, with its certificate in it.

All deny what no rule allows: servers and routers what clients may not do, and clients what comes
from anyone but the server or a router.
"""

import base64
import json
from collections.abc import Mapping, Sequence

from triquad_format.wire.endpoints import DEFAULT_PORT

from triquad_tools.credentials.certificates import Certificate

_WARNING = """\
// Written by triquad-keys, which writes it again with each change: what is changed here is lost.
// It holds a private key: a program that can read it can do what {title} may do.
"""


def listening(title: str, own: Certificate, authority: Certificate, access: object) -> bytes:
    """Return the file of a server or router, with its section ``access_control``."""
    listen = {"endpoints": [_endpoint("0.0.0.0")], "exit_on_failure": True}
    tls = _tls(own, authority, "listen", "connect")
    return _text(title, tls, access, {"mode": "router", "listen": listen})


def connecting(
    title: str, own: Certificate, authority: Certificate, access: object, hosts: Sequence[str]
) -> bytes:
    """Return the file of a client, which finds the server at one of ``hosts``."""
    once = {"timeout_ms": 0, "exit_on_failure": True}  # one attempt at each
    connect = {"endpoints": [_endpoint(host) for host in hosts], **once}
    # ROS 2 keeps the last messages of some topics, which needs their times.
    values = {"mode": "client", "connect": connect, "timestamping": {"enabled": True}}
    return _text(title, _tls(own, authority, "connect"), access, values)


def _text(title: str, tls: object, access: object, values: Mapping[str, object]) -> bytes:
    """Return a file that neither looks for others nor shares memory, as zenoh_config.QUIET."""
    off = {"enabled": False}
    transport = {"shared_memory": off, "link": {"protocols": ["tls"], "tls": tls}}
    scouting = {"multicast": off, "gossip": off}
    whole = {**values, "scouting": scouting, "transport": transport, "access_control": access}
    return (_WARNING.format(title=title) + json.dumps(whole, indent=2) + "\n").encode()


def _tls(own: Certificate, authority: Certificate, *sides: str) -> dict[str, object]:
    """Have both ends of a link show their certificates, and end it when one expires."""
    section: dict[str, object] = {
        "root_ca_certificate_base64": _base64(authority.pem),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    for side in sides:
        section[f"{side}_certificate_base64"] = _base64(own.pem)
        section[f"{side}_private_key_base64"] = _base64(own.key_pem)
    return section


def _endpoint(host: str) -> str:
    return f"tls/[{host}]:{DEFAULT_PORT}" if ":" in host else f"tls/{host}:{DEFAULT_PORT}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
