"""Configurations of Zenoh, one file for each who takes part, with the certificates in it.

Everybody denies what no rule allows: servers and routers what clients may not do, and clients
what comes from anyone but the server or a router.
"""

import base64
import json
from collections.abc import Sequence
from typing import Any

from triquad_format.wire.endpoints import DEFAULT_PORT
from triquad_format.wire.zenoh_config import QUIET

from triquad_tools.credentials.certificate import Certificate

Section = dict[str, Any]

_EVERYWHERE = "0.0.0.0"
_WARNING = """\
// Written by triquad-keys, which writes it anew: what is changed here is lost.
// It holds a private key: whoever can read it can do what {title} may do.
"""


def listening(title: str, own: Certificate, authority: Certificate, access: Section) -> bytes:
    """That of a server or router which ``access`` controls; ``title`` tells people whose it is."""
    values = {
        **_common("router", _tls(own, authority, "listen", "connect"), access),
        "listen/endpoints": [_endpoint(_EVERYWHERE)],
        "listen/exit_on_failure": True,
    }
    return _text(title, values)


def connecting(
    title: str, own: Certificate, authority: Certificate, access: Section, hosts: Sequence[str]
) -> bytes:
    """That of a client, which finds the server at one of ``hosts``."""
    values = {
        **_common("client", _tls(own, authority, "connect"), access),
        "connect/endpoints": [_endpoint(host) for host in hosts],
        "connect/timeout_ms": 0,  # one attempt at each
        "connect/exit_on_failure": True,
        # ROS 2 keeps the last messages of some topics, which needs their times.
        "timestamping/enabled": True,
    }
    return _text(title, values)


def _common(mode: str, tls: Section, access: Section) -> Section:
    return {
        "mode": mode,
        **QUIET,
        "transport/link/protocols": ["tls"],
        "transport/link/tls": tls,
        "access_control": access,
    }


def _tls(own: Certificate, authority: Certificate, *sides: str) -> Section:
    """Both sides of a link show their certificates, and end it when one expires."""
    section: Section = {
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


def _text(title: str, values: Section) -> bytes:
    configuration = json.dumps(_nested(values), indent=2)
    return (_WARNING.format(title=title) + configuration + "\n").encode()


def _nested(values: Section) -> Section:
    """Values by path as sections within sections."""
    outermost: Section = {}
    for path, value in values.items():
        *names, last = path.split("/")
        section = outermost
        for name in names:
            section = section.setdefault(name, {})
        section[last] = value
    return outermost
