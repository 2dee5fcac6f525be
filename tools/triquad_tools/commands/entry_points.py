"""The installed commands: each says in one line what to install where a library is missing."""

import importlib
import importlib.util
import sys

_SERVER_NEEDS = ("torch", "foxglove_schemas_protobuf")


def bench() -> int:
    """``triquad-bench``."""
    return _run("triquad-bench", "triquad_tools.commands.bench", extra="demo", needs=_SERVER_NEEDS)


def demo() -> int:
    """``triquad-demo``."""
    return _run("triquad-demo", "triquad_tools.commands.demo", extra="demo", needs=_SERVER_NEEDS)


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


def _run(command: str, module: str, *, extra: str = "tools", needs: tuple[str, ...] = ()) -> int:
    """Run the ``main`` of a module; ``needs`` are libraries that its processes import later."""
    try:
        for name in needs:
            if importlib.util.find_spec(name) is None:
                raise ModuleNotFoundError(name=name)
        return int(importlib.import_module(module).main())
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        library = error.name.partition(".")[0]
        print(f"{command}: {library} is missing: install triquad[{extra}]", file=sys.stderr)
        return 2
