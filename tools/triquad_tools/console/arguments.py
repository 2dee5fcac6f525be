"""Types of command-line arguments, whose errors name the value and a remedy, and shared ones."""

import argparse
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import triquad_format
from triquad_format.wire.endpoints import DEFAULT_ENDPOINT
from triquad_format.wire.keys import DEFAULT_MAP
from triquad_format.wire.limits import MAX_FILL_M

if TYPE_CHECKING:
    from triquad_client import Client

PAGE_PORT = 8080  # of the page that shows a map
Place = tuple[float, float, float]  # metres

MAP_SUFFIX, PICTURE_SUFFIX, SCANS_SUFFIX = ".triquad", ".png", ".mcap"
MESH_SUFFIXES = (".ply", ".glb", ".obj", ".stl")
NAV2_SUFFIX, OCTOMAP_SUFFIX, GRID_SUFFIX = ".yaml", ".bt", ".npz"
SUFFIXES = (
    MAP_SUFFIX,
    *MESH_SUFFIXES,
    PICTURE_SUFFIX,
    NAV2_SUFFIX,
    OCTOMAP_SUFFIX,
    GRID_SUFFIX,
)
"""How the names of the files end that commands write."""

_FARTHEST_M = 100.0  # that a sensor sits from the frame of its clouds


def command_parser(prog: str, description: str, epilog: str = "") -> argparse.ArgumentParser:
    """Return the parser of a command, which can print its version."""
    parser = argparse.ArgumentParser(prog, description=description, epilog=epilog)
    version = f"triquad {triquad_format.__version__}"
    parser.add_argument("--version", action="version", version=version)
    return parser


def positive(text: str) -> float:
    """Return a number above 0."""
    value = not_negative(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError("0 is not allowed: use a positive number")
    return value


def within(least: float, most: float | None, text: str) -> float:
    """Return a finite number of a range; without ``most`` it has no end."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < least or (most is not None and value > most):
        values = f"at least {least:g}" if most is None else f"{least:g} to {most:g}"
        raise argparse.ArgumentTypeError(f"{text!r:.40} is not a number in range: use {values}")
    return value


def picture(text: str) -> Path:
    """Return the name of a picture to be written, in a folder that exists."""
    path = Path(text)
    if path.suffix != PICTURE_SUFFIX:
        raise argparse.ArgumentTypeError(f"{text}: its name must end in .png")
    if path.is_dir() or not path.parent.is_dir():
        kind = "it is a folder" if path.is_dir() else "its folder does not exist"
        raise argparse.ArgumentTypeError(f"{text}: {kind}")
    return path


def whole(least: int, most: int | None, text: str) -> int:
    """Return a whole number of a range; without ``most`` it has no end."""
    digits = text.isascii() and text.isdigit()
    if not digits or int(text) < least or (most is not None and int(text) > most):
        values = f"{least}, {least + 1}, ..." if most is None else f"{least} to {most}"
        raise argparse.ArgumentTypeError(
            f"{text!r:.40} is not a whole number in range: use {values}"
        )
    return int(text)


not_negative = partial(within, 0.0, None)  # returns a finite number of at least 0
count = partial(whole, 1, None)  # returns a whole number of at least 1
seed = partial(whole, 0, None)  # returns a whole number of at least 0
port = partial(whole, 0, 65_535)  # returns a port to listen on; 0: any that is free


def add_server(parser: argparse.ArgumentParser) -> None:
    """Add the map and the server; a command that can do without one gets ``None`` for each."""
    server = f"of the server (default: that of --config, or {DEFAULT_ENDPOINT})"
    parser.add_argument("--connect", "-e", metavar="ENDPOINT", help=server)
    name = f"of the server's maps (default: {DEFAULT_MAP})"
    parser.add_argument("--map", metavar="NAME", help=name)
    add_config(parser)


def add_fill(parser: argparse.ArgumentParser) -> None:
    """Add the option to continue surface; see :func:`triquad_tools.mapping.output.check_fill`."""
    fill = "of a mesh or a picture: continue surface into unknown space, where the field does, up "
    fill += f"to so far from what was seen, at most {MAX_FILL_M:g} m; those faces are marked"
    most = partial(within, 0.0, MAX_FILL_M)
    parser.add_argument("--fill", type=most, default=0.0, metavar="M", help=fill)


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the option for the credentials of a server."""
    file = "Zenoh configuration (JSON5) to connect with, such as one of triquad-keys"
    parser.add_argument("--config", type=Path, metavar="FILE", help=file)


def connect_to(options: argparse.Namespace, **more: Any) -> "Client":
    """Return a client of the map and the server that the arguments name."""
    import triquad_client  # slow to import

    name = options.map or DEFAULT_MAP
    return triquad_client.connect(options.connect, name, config=options.config, **more)


def server_name(options: argparse.Namespace) -> str:
    """Return the server that the arguments name, for people."""
    return str(options.connect or options.config or DEFAULT_ENDPOINT)


def place(text: str) -> Place:
    """Return a place such as ``0.9,0,1.8``, metres."""
    try:
        x, y, z = (within(-_FARTHEST_M, _FARTHEST_M, number) for number in text.split(","))
    except (ValueError, argparse.ArgumentTypeError) as error:
        raise argparse.ArgumentTypeError(
            f"{text!r}: use X,Y,Z in metres, such as 0.9,0,1.8 ({error})"
        ) from error
    return x, y, z
