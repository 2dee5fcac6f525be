"""Kinds of command-line arguments; what cannot be used is refused with the value and a remedy."""

import argparse
import math


def positive(text: str) -> float:
    """A number above 0."""
    value = not_negative(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError("0 is not allowed: use a positive number")
    return value


def not_negative(text: str) -> float:
    """A finite number of at least 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least 0")
    return value


def count(text: str) -> int:
    """A whole number of at least 1."""
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a count: use 1, 2, ...")
    return int(text)


def seed(text: str) -> int:
    """A whole number of at least 0."""
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a seed: use 0, 1, ...")
    return int(text)
