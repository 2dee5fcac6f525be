"""A folder of keys: the authority with its register, and a file for each server and client.

::

    server.json5, router.json5   for triquad-server --config, and for a router of Zenoh
    NAME.json5                   all that a client needs, to be moved to where it runs
    authority/                   the authority's own: a program that can read it can take any role

Files and folders can be read by their owner alone, and each is written as a whole or not at all.
Configurations deny what no rule allows: servers and routers what clients may not do, and clients
what comes from anyone but the server or a router.
"""

import base64
import json
import os
import re
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path

from triquad_format.mapfile.files import replacing
from triquad_format.wire.access_control import Grant, access_control
from triquad_format.wire.endpoints import DEFAULT_PORT

from triquad_tools.console.command import ToolError
from triquad_tools.credentials.certificates import LOCAL_HOSTS, Authority, Certificate
from triquad_tools.credentials.roles import (
    ROUTER,
    SERVER,
    Holder,
    Role,
    client_grants,
    server_grants,
)

LISTENING = (SERVER, ROUTER)  # roles that listen: no client can have the names of their files

_WARNING = """\
// Written by triquad-keys, which writes it again with each change: what is changed here is lost.
// It holds a private key: a program that can read it can do what {title} may do.
"""

_HOST = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?|[0-9A-Fa-f:]*:[0-9A-Fa-f:.]*")
_NAME_LENGTH = 48  # with role and issue it has to fit into the 64 characters of a common name
_AUTHORITY = "authority"


class KeyFolder:
    """The keys of the servers and clients that trust one authority.

    ``hosts`` are those of servers and routers. ``holders`` are the clients by name, in the order in
    which they got their roles, and ``expires`` tells until when their certificates are valid, UTC.
    """

    def __init__(self, path: Path) -> None:
        """Open a folder."""
        self.path = path
        try:
            read = json.loads(self._register.read_bytes())
            self.hosts = tuple(read["hosts"])
            self.holders: dict[str, Holder] = {}
            self.expires: dict[str, datetime] = {}
            for role in read["roles"]:
                self.expires[role["name"]] = datetime.fromisoformat(role.pop("expires"))
                role |= {"role": Role(role["role"]), "sources": tuple(role["sources"])}
                self.holders[role["name"]] = Holder(**role)
        except FileNotFoundError as error:
            raise ToolError(f"{path} holds no keys: triquad-keys init {path}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise ToolError(f"{self._register} is damaged: {error!r}") from error
        self.authority = Authority(self.certificate(_AUTHORITY))

    @classmethod
    def create(cls, path: Path, hosts: Sequence[str], days: float) -> "KeyFolder":
        """Make a new folder, with an authority, a server and a router on ``hosts``, and no clients.

        Raises:
            ToolError: the folder exists, or a host is neither a name nor an address.
            OSError: it cannot be written.
        """
        for host in hosts:
            if not _HOST.fullmatch(host):
                raise ToolError(f"host {host!r}: use a name or an address, without a port")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.mkdir(mode=0o700)
        except FileExistsError as error:
            raise ToolError(f"{path} is there already: choose another folder") from error
        (path / _AUTHORITY).mkdir(mode=0o700)
        authority = Authority.create(f"triquad authority {path.resolve().name}"[:64])
        _store(path, _AUTHORITY, authority.own)
        for name in LISTENING:
            _store(path, name, authority.server(name, hosts, days))
        register = json.dumps({"hosts": hosts, "roles": []})
        _write(path / _AUTHORITY / "register.json", register.encode())
        created = cls(path)
        created._write_access()
        return created

    def add(self, holder: Holder, days: float) -> Path:
        """Give a role; return the file with which its holder connects.

        Raises:
            ToolError: another client has the name or a source, or the name cannot be one.
            OSError: it cannot be written.
        """
        if holder.name in (*LISTENING, _AUTHORITY):
            raise ToolError(f"{holder.name!r} is not a name for a role: choose another")
        if len(holder.name) > _NAME_LENGTH:
            raise ToolError(f"{holder.name!r} has more than {_NAME_LENGTH} characters")
        for other in self.holders.values():
            if other.name == holder.name:
                raise ToolError(
                    f"{other.name!r} is there already, with the role {other.role.value}: "
                    "remove it first, or renew it"
                )
            for source in set(holder.sources) & set(other.sources):
                raise ToolError(
                    f"source {source!r} is that of {other.name!r}: each source has one publisher"
                )
        return self._issue(replace(holder, issue=secrets.token_hex(4)), days)

    def renew(self, name: str, days: float) -> Path:
        """Issue a new certificate; return the file that replaces the old one.

        Raises:
            ToolError: there is no such client, server or router.
            OSError: it cannot be written.
        """
        if name not in LISTENING:
            return self._issue(self.holder(name), days)
        _store(self.path, name, self.authority.server(name, self.hosts, days))
        self._write_access()
        return self._file(name)

    def remove(self, name: str) -> None:
        """Remove a role: servers that are started again let its holder do nothing any more.

        Raises:
            ToolError: there is no such client.
            OSError: it cannot be written.
        """
        del self.holders[self.holder(name).name]
        self._write_access()
        self._file(name).unlink(missing_ok=True)  # it may have been moved to its holder

    def holder(self, name: str) -> Holder:
        """Return the client of this name.

        Raises:
            ToolError: there is none.
        """
        if name not in self.holders:
            names = ", ".join(self.holders) or "nobody"
            raise ToolError(f"nobody is called {name!r}; there are: {names}")
        return self.holders[name]

    def certificate(self, name: str) -> Certificate:
        """Return the certificate of the server, the router or the authority."""
        stem = self.path / _AUTHORITY / name
        return Certificate(Path(f"{stem}.pem").read_bytes(), Path(f"{stem}-key.pem").read_bytes())

    def _issue(self, holder: Holder, days: float) -> Path:
        own = self.authority.client(holder.common_name, days)
        endpoints = [_endpoint(host) for host in self.hosts or LOCAL_HOSTS[:1]]
        values = {
            "mode": "client",
            # One attempt at each.
            "connect": {"endpoints": endpoints, "timeout_ms": 0, "exit_on_failure": True},
            # ROS 2 keeps the last messages of some topics, which needs their times.
            "timestamping": {"enabled": True},
        }
        title = f"{holder.role.value} {holder.name}"
        file = self._configure(holder.name, title, own, client_grants(), values)
        self.holders[holder.name], self.expires[holder.name] = holder, own.expires
        self._write_access()
        return file

    def _write_access(self) -> None:
        """Write the register, and the files of the server and the router that follow from it."""
        holders = tuple(self.holders.values())
        roles = [
            {**asdict(one), "role": one.role.value, "expires": str(self.expires[one.name])}
            for one in holders
        ]
        register = json.dumps({"hosts": self.hosts, "roles": roles}, indent=2)
        _write(self._register, register.encode())
        listen = {"endpoints": [_endpoint("0.0.0.0")], "exit_on_failure": True}
        values, grants = {"mode": "router", "listen": listen}, server_grants(holders)
        for name in LISTENING:
            self._configure(name, f"the {name}", self.certificate(name), grants, values)

    def _configure(
        self,
        name: str,
        title: str,
        own: Certificate,
        grants: Sequence[Grant],
        values: Mapping[str, object],
    ) -> Path:
        """Write a file that neither looks for others nor shares memory, as zenoh_config.QUIET.

        Both ends of a link show their certificates, and end it when one expires.
        """
        tls: dict[str, object] = {
            "root_ca_certificate_base64": _base64(self.authority.own.pem),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        for side in ("listen", "connect") if "listen" in values else ("connect",):
            tls[f"{side}_certificate_base64"] = _base64(own.pem)
            tls[f"{side}_private_key_base64"] = _base64(own.key_pem)
        off, link = {"enabled": False}, {"protocols": ["tls"], "tls": tls}
        whole = {
            **values,
            "scouting": {"multicast": off, "gossip": off},
            "transport": {"shared_memory": off, "link": link},
            "access_control": access_control(grants),
        }
        file = self._file(name)
        _write(file, (_WARNING.format(title=title) + json.dumps(whole, indent=2) + "\n").encode())
        return file

    @property
    def _register(self) -> Path:
        return self.path / _AUTHORITY / "register.json"

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.json5"


def _store(path: Path, name: str, certificate: Certificate) -> None:
    _write(path / _AUTHORITY / f"{name}-key.pem", certificate.key_pem)
    _write(path / _AUTHORITY / f"{name}.pem", certificate.pem)


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as stream:
        os.fchmod(stream.fileno(), 0o600)  # before there is anything to read in it
        stream.write(data)


def _endpoint(host: str) -> str:
    return f"tls/[{host}]:{DEFAULT_PORT}" if ":" in host else f"tls/{host}:{DEFAULT_PORT}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
