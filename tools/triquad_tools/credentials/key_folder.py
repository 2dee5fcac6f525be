"""A folder of keys: the authority with its register, and a file for each who takes part.

::

    server.json5, router.json5   for triquad-server --config, and for a router of Zenoh
    NAME.json5                   all that a client needs, to be moved to where it runs
    authority/                   the authority's own: whoever can read it can take any role
"""

import re
import secrets
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from triquad_format.wire.access_control import access_control
from triquad_format.wire.roles import ROUTER, SERVER, Holder, client_grants, server_grants

from triquad_tools.console.command import ToolError
from triquad_tools.credentials import configurations, private_files
from triquad_tools.credentials.authority import LOCAL_HOSTS, Authority
from triquad_tools.credentials.certificate import Certificate
from triquad_tools.credentials.register import Entry, Register

LISTENING = (SERVER, ROUTER)
"""Who listens; each has a file of its own, whose name nobody else can have."""

_HOST = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?|[0-9A-Fa-f:]*:[0-9A-Fa-f:.]*")
_NAME_LENGTH = 48  # with role and issue it has to fit into the 64 characters of a common name
_AUTHORITY = "authority"
_REGISTER = "register.json"


class KeyFolder:
    """The keys of the servers and clients that trust one authority."""

    def __init__(self, path: Path) -> None:
        """Open a folder.

        Raises:
            ToolError: it is no folder of keys, or damaged.
            OSError: it cannot be read.
        """
        self.path = path
        try:
            self.register = Register.read((path / _AUTHORITY / _REGISTER).read_bytes())
        except FileNotFoundError as error:
            raise ToolError(f"{path} holds no keys: triquad-keys init {path}") from error
        except ValueError as error:
            raise ToolError(f"{path / _AUTHORITY / _REGISTER} is damaged: {error}") from error
        self.authority = Authority(self._stored(_AUTHORITY))

    @classmethod
    def create(cls, path: Path, hosts: Sequence[str], days: float) -> "KeyFolder":
        """A new folder, with an authority, a server and a router on ``hosts``, and no clients.

        Raises:
            ToolError: the folder is there already, or a host cannot be one.
            OSError: it cannot be written.
        """
        for host in hosts:
            if not _HOST.fullmatch(host):
                raise ToolError(f"host {host!r}: use a name or an address, without a port")
        try:
            private_files.create_folder(path)
        except FileExistsError as error:
            raise ToolError(f"{path} is there already: choose another folder") from error
        private_files.create_folder(path / _AUTHORITY)
        authority = Authority.create(f"triquad authority {path.resolve().name}"[:64])
        _store(path, _AUTHORITY, authority.own)
        for name in LISTENING:
            _store(path, name, authority.server(name, hosts, days))
        private_files.write(path / _AUTHORITY / _REGISTER, Register(tuple(hosts)).text())
        created = cls(path)
        created._write_access()
        return created

    def add(self, holder: Holder, days: float) -> Path:
        """Give a role; returns the file with which its holder connects.

        Raises:
            ToolError: the name or a source is another's, or the name cannot be one.
            OSError: it cannot be written.
        """
        if holder.name in (*LISTENING, _AUTHORITY):
            raise ToolError(f"{holder.name!r} is not a name for a role: choose another")
        if len(holder.name) > _NAME_LENGTH:
            raise ToolError(f"{holder.name!r} has more than {_NAME_LENGTH} characters")
        self.register.check_free(holder.name, holder.sources)
        return self._issue(replace(holder, issue=secrets.token_hex(4)), days)

    def renew(self, name: str, days: float) -> Path:
        """A new certificate for who has one; returns the file that takes the place of the old one.

        Raises:
            ToolError: nobody has this name.
            OSError: it cannot be written.
        """
        if name not in LISTENING:
            return self._issue(self.register.holder(name), days)
        _store(self.path, name, self.authority.server(name, self.register.hosts, days))
        self._write_access()
        return self._file(name)

    def remove(self, name: str) -> None:
        """Take a role away: servers that start anew let its holder do nothing any more.

        Raises:
            ToolError: nobody has this name.
            OSError: it cannot be written.
        """
        self.register.holder(name)
        self._write_register(self.register.without(name))
        self._file(name).unlink(missing_ok=True)  # it may have been moved to its holder

    def certificate(self, name: str) -> Certificate:
        """That of the server, the router or the authority."""
        return self._stored(name)

    def _issue(self, holder: Holder, days: float) -> Path:
        own = self.authority.client(holder.common_name, days)
        file = self._file(holder.name)
        hosts = self.register.hosts or LOCAL_HOSTS[:1]
        title = f"{holder.role.value} {holder.name}"
        access = access_control(client_grants())
        authority = self.authority.own
        private_files.write(file, configurations.connecting(title, own, authority, access, hosts))
        self._write_register(self.register.with_entry(Entry(holder, own.expires)))
        return file

    def _write_register(self, register: Register) -> None:
        private_files.write(self.path / _AUTHORITY / _REGISTER, register.text())
        self.register = register
        self._write_access()

    def _write_access(self) -> None:
        """Write what servers and routers go by."""
        access = access_control(server_grants(self.register.holders))
        for name in LISTENING:
            text = configurations.listening(
                f"the {name}", self._stored(name), self.authority.own, access
            )
            private_files.write(self._file(name), text)

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.json5"

    def _stored(self, name: str) -> Certificate:
        folder = self.path / _AUTHORITY
        return Certificate(
            (folder / f"{name}.pem").read_bytes(), (folder / f"{name}-key.pem").read_bytes()
        )


def _store(path: Path, name: str, certificate: Certificate) -> None:
    folder = path / _AUTHORITY
    private_files.write(folder / f"{name}-key.pem", certificate.key_pem)
    private_files.write(folder / f"{name}.pem", certificate.pem)
