"""``triquad-keys``: who may do what on a server, by certificates."""

import argparse
from collections.abc import Sequence
from datetime import datetime, timezone
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import command_parser, positive, whole
from triquad_tools.console.command import OK, print_line, run
from triquad_tools.console.report import print_columns
from triquad_tools.credentials.key_folder import LISTENING, KeyFolder
from triquad_tools.credentials.roles import Holder, Role

_DAYS = 365.0
_LAST_DOMAIN = 232  # of ROS 2
_ROLES = {
    Role.VIEWER: "may question the map and follow it",
    Role.ROBOT: "may publish scans, as the sources named, and what a viewer may",
    Role.ADMIN: "may reset the map and have checkpoints written, and what a viewer may; with "
    "--source, publish scans too",
}
_RESTART = "start servers and routers again, for they read their file when they start"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool: 0 done, 2 wrong usage, or a folder that cannot be used."""
    options = _parser().parse_args(argv)
    return run("triquad-keys", partial(options.work, options))


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


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "triquad-keys",
        description="Give roles to those who use a map server: a certificate authority in a "
        "folder, and a Zenoh configuration for the server, routers and each client, who may do "
        "what their roles say, and nothing else. docs/security.md tells more.",
        epilog="Exit status: 0 done, 2 wrong usage, or a folder that cannot be used.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, what: str, work: object) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=what, description=what)
        added.set_defaults(work=work, source=None, ros2_domain=None)
        added.add_argument("folder", type=Path, metavar="DIR", help="the folder of keys")
        return added

    init = command("init", "make a new folder, with the clients viewer, robot and admin", _init)
    hosts = "name or address by which others find the server, or a router, repeatable; the machine "
    hosts += "itself finds it without"
    init.add_argument("--host", action="append", default=[], metavar="HOST", help=hosts)
    _add_sources(init, default=" (default: default)")
    with_days = [init]
    for role, may in _ROLES.items():
        add = command(role.value, f"add one who {may}", _add)
        add.set_defaults(role=role)
        add.add_argument("name", metavar="NAME", help="of the client")
        if role is not Role.VIEWER:
            _add_sources(add, required=role is Role.ROBOT)
        with_days.append(add)
    renew = command("renew", "issue new certificates before the old ones expire", _renew)
    renew.add_argument("name", nargs="+", metavar="NAME", help="of a client, server or router")
    until = f"until the certificate expires (default: {_DAYS:g})"
    for one in (*with_days, renew):
        one.add_argument("--days", type=positive, default=_DAYS, metavar="N", help=until)
    remove = command("remove", "take a role away", _remove)
    remove.add_argument("name", metavar="NAME", help="of a client")
    command("list", "tell who has which role, and until when", _list)
    return parser


def _add_sources(
    command: argparse.ArgumentParser, *, default: str = "", required: bool = False
) -> None:
    add = command.add_argument
    sources = f"of scans that the robot publishes, and nobody else, repeatable{default}"
    add("--source", action="append", required=required, metavar="NAME", help=sources)
    domain = "let nodes of ROS 2 with this certificate take part in this domain"
    add("--ros2-domain", type=partial(whole, 0, _LAST_DOMAIN), metavar="N", help=domain)
