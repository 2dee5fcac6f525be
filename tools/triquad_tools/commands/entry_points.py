"""The installed commands: each says in one line what to install where a library is missing."""

import importlib
import importlib.util
from functools import partial

from triquad_tools.console.command import BAD_INPUT, INTERRUPTED, complain


def _run(command: str, module: str, *, extra: str = "tools", needs: tuple[str, ...] = ()) -> int:
    """Run the ``main`` of a command; ``needs`` are libraries that its processes import later."""
    try:
        for name in needs:
            if importlib.util.find_spec(name) is None:
                raise ModuleNotFoundError(name=name)
        return int(importlib.import_module(f"triquad_tools.commands.{module}").main())
    except KeyboardInterrupt:  # while libraries are imported
        return complain(command, "interrupted", INTERRUPTED)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        library = error.name.partition(".")[0]
        return complain(command, f"{library} is missing: install triquad[{extra}]", BAD_INPUT)


_run_with_server = partial(_run, extra="demo", needs=("torch", "foxglove_schemas_protobuf"))

bench = partial(_run_with_server, "triquad-bench", "bench")
demo = partial(_run_with_server, "triquad-demo", "demo")
evaluate = partial(_run, "triquad-eval", "evaluate")
inspect = partial(_run, "triquad-inspect", "inspect")
map_recording = partial(_run_with_server, "triquad-map", "map_recording")
pack = partial(_run, "triquad-pack", "pack")
replay = partial(_run, "triquad-replay", "replay")
