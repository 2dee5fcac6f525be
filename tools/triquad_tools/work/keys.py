"""``triquad-keys``: who may do what on a server, by certificates."""

import argparse
from datetime import datetime, timezone

from triquad_tools.console.command import OK, print_line
from triquad_tools.console.report import print_columns
from triquad_tools.credentials.key_folder import KeyFolder
from triquad_tools.credentials.roles import ADMIN, ROBOT, VIEWER, Holder

_RESTART = "start servers and routers again, for they read their file when they start"


def work(options: argparse.Namespace) -> int:
    """Do what is asked of a folder of keys."""
    path, name, days = options.folder, options.name, options.days
    sources, domain = tuple(dict.fromkeys(options.source)), options.ros2_domain
    if options.action == "init":
        folder = KeyFolder.create(path, options.host, days)
        folder.add(Holder("viewer", VIEWER), days)
        folder.add(Holder("robot", ROBOT, sources or ("default",), domain), days)
        folder.add(Holder("admin", ADMIN), days)
        print_line(f"{path} is ready; keep it to yourself, {path / 'authority.json'} above all.")
        print_line(f"  triquad-server --config {path / 'server.json5'}")
        print_line(f"  triquad-top --config {path / 'viewer.json5'}")
        return OK
    folder = KeyFolder.open(path)
    if options.action == "list":
        _list(folder)
    elif options.action == "renew":
        for each in name:
            print_line(str(folder.renew(each, days)))
        print_line("the old ones are valid until they expire; put the new files in their place")
    elif options.action == "remove":
        folder.remove(name)
        print_line(f"{name} has no role any more; {_RESTART}")
    else:
        file = folder.add(Holder(name, options.action, sources, domain), days)
        print_line(f"{file}: move it to where {name} runs; {_RESTART}")
    return OK


def _list(folder: KeyFolder) -> None:
    rows = []
    for name, holder in folder.holders.items():
        found = folder.hosts or ("this machine",) if holder.listens else holder.sources
        domain = "" if holder.ros2_domain is None else str(holder.ros2_domain)
        expires = folder.certificates[name].parsed.not_valid_after_utc
        expired = " EXPIRED" if expires < datetime.now(timezone.utc) else ""
        rows.append((name, holder.role, ", ".join(found), domain, f"{expires:%Y-%m-%d}{expired}"))
    titles = ("name", "role", "hosts or sources", "ROS 2 domain", "expires")
    print_columns(titles, rows, words=("role", "hosts or sources", "expires"))
