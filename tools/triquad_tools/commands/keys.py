"""``triquad-keys``: who may do what on a server, by certificates."""

import argparse
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import command_parser, positive, whole
from triquad_tools.console.command import run_work
from triquad_tools.credentials.roles import Role

_DAYS = 365.0
_LAST_DOMAIN = 232  # of ROS 2
_ROLES = {
    Role.VIEWER: "may question the map and follow it",
    Role.ROBOT: "may publish scans, as the sources named, and what a viewer may",
    Role.ADMIN: "may reset the map and have checkpoints written, and what a viewer may; with "
    "--source, publish scans too",
}


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "triquad-keys",
        description="Give roles to those who use a map server: a certificate authority in a "
        "folder, and a Zenoh configuration for the server, routers and each client, who may do "
        "what their roles say, and nothing else. docs/security.md tells more.",
        epilog="Exit status: 0 done, 2 wrong usage, or a folder that cannot be used.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, what: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=what, description=what)
        added.set_defaults(action=name, source=None, ros2_domain=None)
        added.add_argument("folder", type=Path, metavar="DIR", help="the folder of keys")
        return added

    init = command("init", "make a new folder, with the clients viewer, robot and admin")
    hosts = "name or address by which others find the server, or a router, repeatable; the machine "
    hosts += "itself finds it without"
    init.add_argument("--host", action="append", default=[], metavar="HOST", help=hosts)
    _add_sources(init, default=" (default: default)")
    with_days = [init]
    for role, may in _ROLES.items():
        add = command(role.value, f"add one who {may}")
        add.set_defaults(role=role)
        add.add_argument("name", metavar="NAME", help="of the client")
        if role is not Role.VIEWER:
            _add_sources(add, required=role is Role.ROBOT)
        with_days.append(add)
    renew = command("renew", "issue new certificates before the old ones expire")
    renew.add_argument("name", nargs="+", metavar="NAME", help="of a client, server or router")
    until = f"until the certificate expires (default: {_DAYS:g})"
    for one in (*with_days, renew):
        one.add_argument("--days", type=positive, default=_DAYS, metavar="N", help=until)
    remove = command("remove", "take a role away")
    remove.add_argument("name", metavar="NAME", help="of a client")
    command("list", "tell who has which role, and until when")
    return parser


def _add_sources(
    command: argparse.ArgumentParser, *, default: str = "", required: bool = False
) -> None:
    add = command.add_argument
    sources = f"of scans that the robot publishes, and nobody else, repeatable{default}"
    add("--source", action="append", required=required, metavar="NAME", help=sources)
    domain = "let nodes of ROS 2 with this certificate take part in this domain"
    add("--ros2-domain", type=partial(whole, 0, _LAST_DOMAIN), metavar="N", help=domain)


main = partial(run_work, "keys", _parser)
