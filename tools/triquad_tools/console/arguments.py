"""Types of command-line arguments; errors name the value and a remedy."""

import argparse
import math
import re
from functools import partial
from pathlib import Path

import triquad_format

_PER_METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0}
_LEAST_ERROR_M, _LARGEST_ERROR_M = 1e-5, 0.1


def add_version(parser: argparse.ArgumentParser) -> None:
    """Let a command print its version."""
    version = f"triquad {triquad_format.__version__}"
    parser.add_argument("--version", action="version", version=version)


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
    if path.suffix != ".png":
        raise argparse.ArgumentTypeError(f"{text}: its name must end in .png")
    if path.is_dir() or not path.parent.is_dir():
        kind = "it is a folder" if path.is_dir() else "its folder does not exist"
        raise argparse.ArgumentTypeError(f"{text}: {kind}")
    return path


def error_limit(text: str) -> float:
    """Return a length with its unit, such as ``2mm``, in metres: 0.01 mm to 10 cm."""
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)(mm|cm|m)", text)
    if match is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a length with its unit: use 2mm, 0.2cm or 0.002m"
        )
    metres = float(match[1]) / _PER_METRE[match[2]]
    if not _LEAST_ERROR_M <= metres <= _LARGEST_ERROR_M:
        raise argparse.ArgumentTypeError(f"{text} is out of range: use 0.01mm to 10cm")
    return metres


def whole(least: int, most: int | None, text: str) -> int:
    """Return a whole number of a range; without ``most`` it has no end."""
    digits = text.isascii() and text.isdigit()
    if not digits or int(text) < least or (most is not None and int(text) > most):
        values = f"{least}, {least + 1}, ..." if most is None else f"{least} to {most}"
        raise argparse.ArgumentTypeError(f"{text!r:.40} is not a whole number: use {values}")
    return int(text)


not_negative = partial(within, 0.0, None)
"""Returns a finite number of at least 0."""

count = partial(whole, 1, None)
"""Returns a whole number of at least 1."""

seed = partial(whole, 0, None)
"""Returns a whole number of at least 0."""

port = partial(whole, 0, 65_535)
"""Returns a port to listen on; 0: any that is free."""
