"""What a process gives back of its memory."""

import subprocess
import sys

import pytest

_CODE = """
from triquad_server.process.memory import give_back_compiler, resident_bytes
import numba

@numba.njit
def doubled(number):
    return 2 * number

assert doubled(21) == 42
before = resident_bytes()
give_back_compiler()
given_back = before - resident_bytes()
assert doubled(4.0) == 8.0  # compiled after it
print(given_back)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells where files lie in memory")
def test_the_compilers_memory_is_given_back_and_it_goes_on_compiling() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _CODE], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20e6
