"""The installed commands: each says in one line what to install where a library is missing."""

import importlib
import sys


def bench() -> int:
    """``triquad-bench``."""
    return _run("triquad-bench", "triquad_tools.commands.bench")


def demo() -> int:
    """``triquad-demo``."""
    return _run("triquad-demo", "triquad_tools.commands.demo")


def evaluate() -> int:
    """``triquad-eval``."""
    return _run("triquad-eval", "triquad_tools.commands.evaluate")


def inspect() -> int:
    """``triquad-inspect``."""
    return _run("triquad-inspect", "triquad_tools.commands.inspect")


def pack() -> int:
    """``triquad-pack``."""
    return _run("triquad-pack", "triquad_tools.commands.pack")


def replay() -> int:
    """``triquad-replay``."""
    return _run("triquad-replay", "triquad_tools.commands.replay")


def _run(command: str, module: str) -> int:
    try:
        return int(importlib.import_module(module).main())
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        print(f"{command}: {error.name} is missing: install triquad[tools]", file=sys.stderr)
        return 2
