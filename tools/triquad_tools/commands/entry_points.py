"""The installed commands: each says in one line what to install where a library is missing."""

import importlib
import importlib.util
import sys
from functools import partial


def _run(command: str, module: str, *, extra: str = "tools", needs: tuple[str, ...] = ()) -> int:
    """Run the ``main`` of a command; ``needs`` are libraries that its processes import later."""
    try:
        for name in needs:
            if importlib.util.find_spec(name) is None:
                raise ModuleNotFoundError(name=name)
        return int(importlib.import_module(f"triquad_tools.commands.{module}").main())
    except KeyboardInterrupt:  # while libraries are imported
        print(f"{command}: interrupted", file=sys.stderr)
        return 130
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        library = error.name.partition(".")[0]
        print(f"{command}: {library} is missing: install triquad[{extra}]", file=sys.stderr)
        return 2


_run_with_server = partial(_run, extra="demo", needs=("torch", "foxglove_schemas_protobuf"))

bench = partial(_run_with_server, "triquad-bench", "bench")
demo = partial(_run_with_server, "triquad-demo", "demo")
evaluate = partial(_run, "triquad-eval", "evaluate")
inspect = partial(_run, "triquad-inspect", "inspect")
pack = partial(_run, "triquad-pack", "pack")
replay = partial(_run, "triquad-replay", "replay")
