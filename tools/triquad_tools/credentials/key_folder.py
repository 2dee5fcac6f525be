"""A folder of keys: a file for each server and client, and the authority with its register.

::

    server.json5, router.json5   for triquad-server --config, and for a router of Zenoh
    NAME.json5                   all that a client needs, to be moved to where it runs
    authority.json               the authority's own: a program that can read it can take any role

They can be read by their owner alone, and each is written as a whole or not at all.
"""

import base64
import json
import os
import re
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from triquad_format.mapfile.files import replacing
from triquad_format.wire.endpoints import full_endpoint
from triquad_format.wire.zenoh_access import access_control

from triquad_tools.console.command import ToolError
from triquad_tools.credentials.certificates import LOCAL_HOSTS, Certificate, new_authority
from triquad_tools.credentials.roles import LISTENING, Holder, grants

_REGISTER = "authority.json"
_WARNING = """\
// Written by triquad-keys, which writes it again with each change: what is changed here is lost.
// It holds a private key: a program that can read it can do what the {} may do.
"""
_HOST = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?|[0-9A-Fa-f:]*:[0-9A-Fa-f:.]*")
_NAME_LENGTH = 48  # with role and issue it has to fit into the 64 characters of a common name


@dataclass(frozen=True)
class KeyFolder:
    """The keys of all who trust one authority.

    ``holders`` are they by name, in the order in which they got their roles: the server and the
    router, to be found on ``hosts``, and clients. Of their ``certificates``, those of clients are
    kept without the keys, which are in the clients' files alone.
    """

    path: Path
    hosts: tuple[str, ...]
    authority: Certificate
    holders: dict[str, Holder] = field(default_factory=dict)
    certificates: dict[str, Certificate] = field(default_factory=dict)

    @classmethod
    def create(cls, path: Path, hosts: Sequence[str], days: float) -> "KeyFolder":
        """Make a new folder, with an authority, a server and a router on ``hosts``, and no clients.

        Raises:
            ToolError: the folder exists, or a host is neither a name nor an address.
            OSError: it cannot be written.
        """
        if path.exists():
            raise ToolError(f"{path} is there already: choose another folder")
        for host in hosts:
            if not _HOST.fullmatch(host) or host.isdigit():
                raise ToolError(f"host {host!r}: use a name or an address, without a port")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700)
        authority = new_authority(f"triquad authority {path.resolve().name}"[:64])
        folder = cls(path, tuple(hosts), authority)
        for role in LISTENING:
            folder._issue(Holder(role, role), days)
        return folder

    @classmethod
    def open(cls, path: Path) -> "KeyFolder":
        """Open a folder; one that is none of keys is a ToolError."""
        try:
            read = json.loads((path / _REGISTER).read_bytes())
            folder = cls(path, tuple(read["hosts"]), Certificate(**read["authority"]))
            for entry in read["holders"]:
                holder = Holder(**entry | {"sources": tuple(entry["sources"])})
                folder.holders[holder.name] = holder
                folder.certificates[holder.name] = Certificate(**read["certificates"][holder.name])
        except FileNotFoundError as error:
            raise ToolError(f"{path} holds no keys: triquad-keys init {path}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise ToolError(f"{path / _REGISTER} is damaged: {error!r}") from error
        return folder

    def add(self, holder: Holder, days: float) -> Path:
        """Give a role to a client; return the file with which it connects.

        Raises:
            ToolError: another one has the name or a source, or the name is too long.
            OSError: it cannot be written.
        """
        if len(holder.name) > _NAME_LENGTH:
            raise ToolError(f"{holder.name!r} has more than {_NAME_LENGTH} characters")
        for other in self.holders.values():
            if other.name == holder.name:
                raise ToolError(
                    f"{other.name!r} is there already, with the role {other.role}: "
                    "choose another name, or remove it first, or renew it"
                )
            for source in set(holder.sources) & set(other.sources):
                raise ToolError(
                    f"source {source!r} is that of {other.name!r}: each source has one publisher"
                )
        return self._issue(replace(holder, issue=secrets.token_hex(4)), days)

    def renew(self, name: str, days: float) -> Path:
        """Issue a new certificate; return the file that has it."""
        return self._issue(self.holder(name), days)

    def remove(self, name: str) -> None:
        """Remove a client: servers that are started again let it do nothing any more."""
        if self.holder(name).listens:
            raise ToolError(f"{name!r} is no client, and cannot be removed")
        del self.holders[name], self.certificates[name]
        self._write()
        self._file(name).unlink(missing_ok=True)  # it may have been moved to its holder

    def holder(self, name: str) -> Holder:
        """Return who has this name; one that nobody has is a ToolError."""
        if name not in self.holders:
            raise ToolError(f"nobody is called {name!r}; there are: {', '.join(self.holders)}")
        return self.holders[name]

    def _issue(self, holder: Holder, days: float) -> Path:
        name, hosts = holder.name, self.hosts if holder.listens else None
        own = self.authority.issue(holder.common_name, days, hosts)
        self._configure(holder, own)
        self.holders[name] = holder
        self.certificates[name] = own if holder.listens else replace(own, key_pem="")
        self._write()
        return self._file(name)

    def _write(self) -> None:
        """Write the register, and the files of the server and the router, which name all roles."""
        register = {
            "hosts": self.hosts,
            "authority": asdict(self.authority),
            "holders": [asdict(holder) for holder in self.holders.values()],
            "certificates": {name: asdict(own) for name, own in self.certificates.items()},
        }
        _write(self.path / _REGISTER, json.dumps(register, indent=2))
        for holder in self.holders.values():
            if holder.listens:
                self._configure(holder, self.certificates[holder.name])

    def _configure(self, holder: Holder, own: Certificate) -> None:
        """Write a file that neither looks for others nor shares memory, as zenoh_config.QUIET.

        Both ends of a link show their certificates, and end it when one expires.
        """
        tls: dict[str, object] = {
            "root_ca_certificate_base64": _base64(self.authority.pem),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        for side in ("listen", "connect") if holder.listens else ("connect",):
            tls[f"{side}_certificate_base64"] = _base64(own.pem)
            tls[f"{side}_private_key_base64"] = _base64(own.key_pem)
        off = {"enabled": False}
        values = {
            "scouting": {"multicast": off, "gossip": off},
            "transport": {"shared_memory": off, "link": {"protocols": ["tls"], "tls": tls}},
            "access_control": access_control(grants(holder, tuple(self.holders.values()))),
        }
        if holder.listens:
            listen = {"endpoints": [full_endpoint("0.0.0.0", "tls")], "exit_on_failure": True}
            values |= {"mode": "router", "listen": listen}
        else:
            endpoints = [full_endpoint(host, "tls") for host in self.hosts or LOCAL_HOSTS[:1]]
            # One attempt at each.
            connect = {"endpoints": endpoints, "timeout_ms": 0, "exit_on_failure": True}
            values |= {"mode": "client", "connect": connect}
            # ROS 2 keeps the last messages of some topics, which needs their times.
            values |= {"timestamping": {"enabled": True}}
        title = " ".join(dict.fromkeys((holder.role, holder.name)))
        text = _WARNING.format(title) + json.dumps(values, indent=2) + "\n"
        _write(self._file(holder.name), text)

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.json5"


def _write(path: Path, text: str) -> None:
    with replacing(path) as stream:
        os.fchmod(stream.fileno(), 0o600)  # before there is anything to read in it
        stream.write(text.encode())


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
