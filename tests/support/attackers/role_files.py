"""Sessions with what ``triquad-keys`` wrote, on ports of the loopback."""

import base64
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh
from triquad_tools.credentials.certificates import Certificate

from bench.clients.server_process import free_port


def free_tls_endpoint() -> str:
    return f"tls/127.0.0.1:{free_port()}"


@contextmanager
def opened(file: Path, endpoint: str | None, **changes: Any) -> Iterator[zenoh.Session]:
    """A session of ``file`` that connects there; as an attacker's, it keeps to no rules of its own.

    ``changes`` are values of the configuration, with ``__`` for ``/`` in their names.
    """
    config = zenoh.Config.from_file(str(file))
    config.insert_json5("connect/endpoints", json.dumps([endpoint] if endpoint else []))
    config.insert_json5("access_control/enabled", "false")
    for name, value in changes.items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def showing(certificate: Certificate, *sides: str) -> dict[str, str]:
    """Changes with which a session shows another certificate."""
    tls = "transport__link__tls"
    shown = {}
    for side in sides or ("connect",):
        shown[f"{tls}__{side}_certificate_base64"] = _base64(certificate.pem)
        shown[f"{tls}__{side}_private_key_base64"] = _base64(certificate.key_pem)
    return shown


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
