"""Compiled code that cannot be used is compiled again before the server is ready."""

import subprocess
import sys

import pytest

_STEP = """
import logging, sys
logging.basicConfig()
sys.path.insert(0, sys.argv[1])
from triquad_server.warm_up import go_through
from toy import doubled
go_through(lambda: doubled(21))
print(doubled(21), sum(doubled.stats.cache_hits.values()))
"""
_TOY = """
from triquad_map.compiled.kernel import kernel

@kernel()
def doubled(number):
    return 2 * number
"""


@pytest.fixture
def step(tmp_path, monkeypatch):
    """Go through a step that uses one kernel, in a process of its own."""
    (tmp_path / "toy.py").write_text(_TOY)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))

    def run():
        command = [sys.executable, "-c", _STEP, str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)

    return run


@pytest.mark.parametrize(
    ("suffix", "left"),
    [
        ("nbi", 0),
        ("nbc", 100),
        pytest.param("nbi", 100, marks=pytest.mark.long),
        pytest.param("nbc", 0, marks=pytest.mark.long),
    ],
)
def test_compiled_code_that_is_damaged_is_compiled_again(tmp_path, step, suffix, left):
    assert step().stdout.split() == ["42", "0"]
    for file in (tmp_path / "cache").rglob(f"*.{suffix}"):
        file.write_bytes(file.read_bytes()[:left])
    process = step()
    assert process.stdout.split() == ["42", "0"]
    assert "may be damaged" in process.stderr
    assert step().stdout.split() == ["42", "1"]
