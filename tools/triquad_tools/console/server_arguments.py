"""The arguments that say which server a command connects to, and with which credentials."""

import argparse
from pathlib import Path

from triquad_format.wire.endpoints import DEFAULT_ENDPOINT

DEFAULT_MAP = "default"


def add_server(parser: argparse.ArgumentParser) -> None:
    """Add the map and the server; a command that can do without one gets ``None`` for each."""
    add = parser.add_argument
    add(
        "--connect",
        "-e",
        metavar="ENDPOINT",
        help=f"of the server (default: that of --config, or {DEFAULT_ENDPOINT})",
    )
    add("--map", metavar="NAME", help=f"of the server's maps (default: {DEFAULT_MAP})")
    add_config(parser)


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the option for the credentials of a server."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="Zenoh configuration (JSON5) to connect with, such as one of triquad-keys",
    )


def server_name(options: argparse.Namespace) -> str:
    """Return the server that the arguments name, for people."""
    return str(options.connect or options.config or DEFAULT_ENDPOINT)
