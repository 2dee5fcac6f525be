"""The installed commands: each says in one line what to install where a library is missing."""

import importlib
import importlib.util
import os
import signal
import sys
from functools import partial

from triquad_tools.console.command import BAD_INPUT, INTERRUPTED, complain


def _run(command: str, module: str, *, extra: str = "tools", needs: tuple[str, ...] = ()) -> int:
    """Run the ``main`` of a command; ``needs`` are libraries that its processes import later."""
    # Closed, as by >&- in a shell. What is opened next would pass for it, an output file too.
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - as long as the process
    _leave_on_interrupt(command)
    try:
        for name in needs:
            if importlib.util.find_spec(name) is None:
                raise ModuleNotFoundError(name=name)
        imported = importlib.import_module(f"triquad_tools.commands.{module}")
        status = int(imported.main())
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("triquad"):
            raise
        library = error.name.partition(".")[0]
        return complain(command, f"{library} is missing: install triquad[{extra}]", BAD_INPUT)
    if status == INTERRUPTED:
        os._exit(status)  # the interpreter's own end would clean up what a compiler has half done
    return status


def _leave_on_interrupt(command: str) -> None:
    """Let Ctrl-C before and after the work end the process: an import could lose an exception."""

    def leave(*_: object) -> None:
        os.write(2, f"{command}: interrupted\n".encode())
        os._exit(INTERRUPTED)

    # What a shell runs in the background ignores it.
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, leave)


_run_with_server = partial(_run, extra="demo", needs=("numba", "foxglove_schemas_protobuf"))

demo = partial(_run_with_server, "triquad-demo", "demo")
evaluate = partial(_run, "triquad-eval", "evaluate")
inspect = partial(_run, "triquad-inspect", "inspect")
keys = partial(_run, "triquad-keys", "keys", extra="keys")
map_recording = partial(_run_with_server, "triquad-map", "map_recording")
pack = partial(_run, "triquad-pack", "pack")
replay = partial(_run, "triquad-replay", "replay")
ros2 = partial(_run, "triquad-ros2", "ros2", extra="ros", needs=("rosbags",))
top = partial(_run, "triquad-top", "top")
view = partial(_run, "triquad-view", "view", extra="viewer", needs=("viser",))
