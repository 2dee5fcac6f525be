"""``triquad-keys``: who may do what on a server, by certificates."""

import argparse
from functools import partial
from pathlib import Path

from triquad_tools.console.arguments import command_parser, positive, whole
from triquad_tools.console.command import run_work
from triquad_tools.credentials.roles import ADMIN, ROBOT, ROLES

_DAYS = 365.0
_LAST_DOMAIN = 232  # of ROS 2


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
        added.set_defaults(action=name, name=None, days=None, source=[], ros2_domain=None)
        added.add_argument("folder", type=Path, metavar="DIR", help="the folder of keys")
        return added

    init = command("init", "make a new folder, with the clients viewer, robot and admin")
    hosts = "name or address by which others find the server, or a router, repeatable; the machine "
    hosts += "itself finds it without"
    init.add_argument("--host", action="append", default=[], metavar="HOST", help=hosts)
    adding = {role: command(role, f"add one who {may}") for role, may in ROLES.items()}
    renew = command("renew", "issue new certificates before the old ones expire")
    renew.add_argument("name", nargs="+", metavar="NAME", help="of a client, server or router")
    for one in (*adding.values(), command("remove", "take a role away")):
        one.add_argument("name", metavar="NAME", help="of the client")
    command("list", "tell who has which role, and until when")
    sources = "of scans that the robot publishes, and nobody else, repeatable (init: default)"
    domain = "let nodes of ROS 2 with this certificate take part in this domain"
    for one in (init, adding[ROBOT], adding[ADMIN]):
        required = one is adding[ROBOT]
        one.add_argument(
            "--source", action="append", required=required, metavar="NAME", help=sources
        )
        one.add_argument(
            "--ros2-domain", type=partial(whole, 0, _LAST_DOMAIN), metavar="N", help=domain
        )
    until = f"until the certificate expires (default: {_DAYS:g})"
    for one in (init, *adding.values(), renew):
        one.add_argument("--days", type=positive, default=_DAYS, metavar="N", help=until)
    return parser


main = partial(run_work, "keys", _parser)
