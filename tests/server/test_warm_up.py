"""All code is compiled before the server is ready, again where it cannot be used."""

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


_FIRST_DRIVE = """
import numpy as np
from triquad_map.compiled import kernel
from triquad_map.questions.distance import distances
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings
from triquad_server.warm_up import warm_up

def ready():
    return {jit.__name__ for jit in kernel._kernels if jit.signatures}

warm_up(Settings(), "cpu")
before, teams = ready(), Teams()
mapper = Mapper("test", Settings(), "cpu", teams=teams)
angles = np.linspace(0, 2 * np.pi, 5000)
points = np.stack([8 * np.cos(angles), 8 * np.sin(angles), np.sin(40 * angles)], axis=1)
for steps in (0, 3):
    mapper.ingest(points.astype(np.float32), np.eye(4))
    for _ in range(steps):
        mapper.train()
    epoch = mapper.publish()
    epoch.query(points, gradient=True)
    distances(epoch, points, unknown_distance=True)
    cache = TileCache(Settings().mesh, teams.background)
    cache.refresh(epoch)
    cache.make(0, (0, 0, 0))
print(*sorted(ready() - before))
"""


def test_the_first_questions_wait_for_no_compiler():
    command = [sys.executable, "-c", _FIRST_DRIVE]
    process = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert process.stdout.split() == []
