"""What an authority remembers: where its servers are found, and to whom it gave which role."""

import datetime
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from triquad_format.wire.roles import Holder, Role

from triquad_tools.console.command import ToolError

_VERSION = 1


@dataclass(frozen=True)
class Entry:
    """A role that was given."""

    holder: Holder
    expires: datetime.datetime  # UTC


@dataclass(frozen=True)
class Register:
    """Hosts of the servers, and all who have a role, in the order in which they got it."""

    hosts: tuple[str, ...]
    entries: tuple[Entry, ...] = ()

    @property
    def holders(self) -> tuple[Holder, ...]:
        """All who have a role."""
        return tuple(entry.holder for entry in self.entries)

    def holder(self, name: str) -> Holder:
        """Who has this name.

        Raises:
            ToolError: nobody has.
        """
        for holder in self.holders:
            if holder.name == name:
                return holder
        names = ", ".join(holder.name for holder in self.holders) or "nobody"
        raise ToolError(f"nobody is called {name!r}; there are: {names}")

    def check_free(self, name: str, sources: Sequence[str]) -> None:
        """Refuse a name or a source of scans that somebody has.

        Raises:
            ToolError: one has it; the text names which.
        """
        for holder in self.holders:
            if holder.name == name:
                raise ToolError(
                    f"{name!r} is there already, with the role {holder.role.value}: "
                    "remove it first, or renew it"
                )
            for source in set(sources) & set(holder.sources):
                raise ToolError(
                    f"source {source!r} is that of {holder.name!r}: each source has one publisher"
                )

    def with_entry(self, entry: Entry) -> "Register":
        """With one more, or the newer entry of one."""
        others = self.without(entry.holder.name).entries
        return replace(self, entries=(*others, entry))

    def without(self, name: str) -> "Register":
        """Without one."""
        entries = tuple(entry for entry in self.entries if entry.holder.name != name)
        return replace(self, entries=entries)

    def text(self) -> bytes:
        """As a file."""
        entries = [
            {
                "name": entry.holder.name,
                "role": entry.holder.role.value,
                "sources": entry.holder.sources,
                "ros2_domain": entry.holder.ros2_domain,
                "issue": entry.holder.issue,
                "expires": entry.expires.isoformat(),
            }
            for entry in self.entries
        ]
        written = {"version": _VERSION, "hosts": self.hosts, "roles": entries}
        return (json.dumps(written, indent=2) + "\n").encode()

    @classmethod
    def read(cls, text: bytes) -> "Register":
        """From a file.

        Raises:
            ValueError: it is none.
        """
        read = json.loads(text)
        try:
            if read["version"] != _VERSION:
                raise ValueError(f"version {read['version']!r} is not {_VERSION}")
            return cls(tuple(read["hosts"]), tuple(map(_entry, read["roles"])))
        except (KeyError, TypeError) as error:
            raise ValueError(f"{error!r}") from error


def _entry(read: dict[str, Any]) -> Entry:
    holder = Holder(
        read["name"],
        Role(read["role"]),
        tuple(read["sources"]),
        read["ros2_domain"],
        issue=read["issue"],
    )
    return Entry(holder, datetime.datetime.fromisoformat(read["expires"]))
