"""Ctrl-C ends every command with one line, wherever it is."""

import re
import subprocess
import sys

import pytest

WAIT_S = 60.0

NAMES = {"inspect": "triquad-inspect", "map_recording": "triquad-map"}

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
    done = run(code, "none.triquad", "none.triquad")
    assert (done.returncode, done.stderr) == (130, f"{NAMES[name]}: interrupted\n")
    assert done.stdout == ""


@pytest.mark.parametrize("module", ["triquad_server.settings", "numba"])
def test_while_the_libraries_of_the_server_are_imported(module: str) -> None:
    code = PRESSED_AT_IMPORT.format(module=module)
    code += "from triquad_server.cli import main\nsys.exit(main())"
    done = run(code)
    assert done.returncode == 0
    assert re.fullmatch(r"\S+ \S+ INFO stopped\n", done.stderr)


def test_work_is_interrupted_and_where_that_is_swallowed_by_a_second_time() -> None:
    code = """
import os, signal, sys, time
from triquad_tools.console.command import run

def press():
    os.kill(os.getpid(), signal.SIGINT)

def work():
    press()
    time.sleep(600)

def failing():
    try:
        press()
    except KeyboardInterrupt as interrupt:
        raise SystemError("as a library says that fails for this reason") from interrupt

def swallowing():
    try:
        press()
    except BaseException:
        pass
    press()
    time.sleep(600)

assert run("triquad-test", work) == run("triquad-test", failing) == 130
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
sys.exit(run("triquad-test", swallowing))
"""
    done = run(code)
    assert (done.returncode, done.stderr) == (130, "triquad-test: interrupted\n" * 2)


def test_who_ignores_interrupts_is_not_interrupted() -> None:
    code = PRESSED_AT_IMPORT.format(module="triquad_tools.commands.inspect")
    code += "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"  # as shells do in the background
    code += "from triquad_tools.commands.entry_points import inspect\nsys.exit(inspect())"
    done = run(code, "--version")
    assert done.returncode == 0
    assert done.stderr == ""
