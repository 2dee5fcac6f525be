"""Ctrl-C ends every command with one line, wherever it is."""

import re
import subprocess
import sys
import textwrap

import pytest

WAIT_S = 60.0

NAMES = {
    "demo": "triquad-demo",
    "evaluate": "triquad-eval",
    "inspect": "triquad-inspect",
    "map_recording": "triquad-map",
    "pack": "triquad-pack",
    "replay": "triquad-replay",
    "top": "triquad-top",
}

PRESSED_AT_IMPORT = """
import os, signal, sys

class Pressed:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Pressed())
"""


def run(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-c", code, *arguments]
    return subprocess.run(line, capture_output=True, text=True, timeout=WAIT_S)


@pytest.mark.parametrize(
    ("name", "module"),
    [*((name, f"triquad_tools.commands.{name}") for name in NAMES), ("inspect", "numpy")],
)
def test_while_libraries_are_imported(name: str, module: str) -> None:
    code = PRESSED_AT_IMPORT.format(module=module)
    code += f"from triquad_tools.commands.entry_points import {name}\nsys.exit({name}())"
    done = run(code, "--version")
    assert (done.returncode, done.stderr) == (130, f"{NAMES[name]}: interrupted\n")
    assert done.stdout == ""


@pytest.mark.parametrize("module", ["triquad_server.settings", "numpy", "numba"])
def test_while_the_libraries_of_the_server_are_imported(module: str) -> None:
    code = PRESSED_AT_IMPORT.format(module=module)
    code += "from triquad_server.cli import main\nsys.exit(main())"
    done = run(code)
    assert done.returncode == 0
    assert re.fullmatch(r"\S+ \S+ INFO stopped\n", done.stderr)


# What work does: it goes on for long, unless the interrupt arrives.
SWALLOWED = {
    "by an import": """
        class Library:
            def find_spec(self, name, path=None, target=None):
                if name == "library":
                    try:
                        press()
                    except BaseException:
                        raise ImportError("as C code says that it could not import numpy")

        sys.meta_path.insert(0, Library())
        try:
            import library
        except ImportError:
            pass
    """,
    "by a finaliser": """
        class Thing:
            def __del__(self):
                press()

        Thing()
    """,
    "by a library that fails then": """
        try:
            press()
        except KeyboardInterrupt as interrupt:
            raise SystemError("returned a result with an exception set") from interrupt
    """,
    "by nobody": "press()",
}


@pytest.mark.parametrize("swallowed", SWALLOWED)
def test_an_interrupt_that_is_swallowed_arrives_later(swallowed: str) -> None:
    code = """
import os, signal, sys, time
from triquad_tools.console.command import run

def press():
    os.kill(os.getpid(), signal.SIGINT)

def work():
{body}
    time.sleep(600)

status = run("triquad-test", work)
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
sys.exit(status)
"""
    body = textwrap.indent(textwrap.dedent(SWALLOWED[swallowed]), "    ")
    done = run(code.format(body=body))
    assert (done.returncode, done.stderr) == (130, "triquad-test: interrupted\n")


def test_who_ignores_interrupts_is_not_interrupted() -> None:
    code = PRESSED_AT_IMPORT.format(module="numpy")
    code += "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"  # as shells do in the background
    code += "from triquad_tools.commands.entry_points import inspect\nsys.exit(inspect())"
    done = run(code, "--version")
    assert done.returncode == 0
    assert done.stderr == ""
