"""``triquad-keys``: who may do what on a server, by certificates."""

import argparse
from datetime import datetime, timezone

from triquad_tools.console.command import OK, print_line
from triquad_tools.console.report import print_columns
from triquad_tools.credentials.key_folder import LISTENING, KeyFolder
from triquad_tools.credentials.roles import Holder, Role

_RESTART = "start servers and routers again, for they read their file when they start"


def work(options: argparse.Namespace) -> int:
    """Do what is asked of a folder of keys."""
    actions = {"init": _init, "renew": _renew, "remove": _remove, "list": _list}
    return actions.get(options.action, _add)(options)


def _init(options: argparse.Namespace) -> int:
    folder = KeyFolder.create(options.folder, options.host, options.days)
    sources = tuple(options.source or ["default"])
    folder.add(Holder("viewer", Role.VIEWER), options.days)
    folder.add(Holder("robot", Role.ROBOT, sources, options.ros2_domain), options.days)
    folder.add(Holder("admin", Role.ADMIN), options.days)
    print_line(
        f"{options.folder} is ready; keep it to yourself, {options.folder / 'authority'} above all."
        f"\n  triquad-server --config {options.folder / 'server.json5'}\n"
        f"  triquad-top --config {options.folder / 'viewer.json5'}"
    )
    return OK


def _add(options: argparse.Namespace) -> int:
    sources = tuple(dict.fromkeys(options.source or ()))
    holder = Holder(options.name, options.role, sources, options.ros2_domain)
    file = KeyFolder(options.folder).add(holder, options.days)
    print_line(f"{file}: move it to where {options.name} runs; {_RESTART}")
    return OK


def _renew(options: argparse.Namespace) -> int:
    folder = KeyFolder(options.folder)
    for name in options.name:
        print_line(str(folder.renew(name, options.days)))
    print_line("the old ones are valid until they expire; put the new files in their place")
    return OK


def _remove(options: argparse.Namespace) -> int:
    KeyFolder(options.folder).remove(options.name)
    print_line(f"{options.name} has no role any more; {_RESTART}")
    return OK


def _list(options: argparse.Namespace) -> int:
    folder = KeyFolder(options.folder)
    hosts = ", ".join(folder.hosts) or "this machine"
    rows = [(name, name, hosts, "", _day(folder.certificate(name).expires)) for name in LISTENING]
    for name, holder in folder.holders.items():
        domain = "" if holder.ros2_domain is None else str(holder.ros2_domain)
        until = _day(folder.expires[name])
        rows.append((name, holder.role.value, ", ".join(holder.sources), domain, until))
    titles = ("name", "role", "hosts or sources", "ROS 2 domain", "expires")
    print_columns(titles, rows, words=("role", "hosts or sources", "expires"))
    return OK


def _day(expires: datetime) -> str:
    return f"{expires:%Y-%m-%d}{' EXPIRED' if expires < datetime.now(timezone.utc) else ''}"
