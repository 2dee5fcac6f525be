"""Maps of a long recording by one process and by workers, one of which is killed amid it."""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from triquad_client import open_map
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive
from triquad_tools.simulation.street import street_drive

from bench.driven import write_recording
from bench.figures import Figure
from bench.street_pieces import PIECE_M, REACH_M, mean_f_score

_LENGTH_M, _STEP_M, _EACH_M = 4000.0, 4.0, 200.0  # from a scored piece to the next
_SETTINGS = (
    *("--set", "training.samples_per_ray=6"),  # of 48: hours are not needed for a ratio
    *("--set", "memory.max_bytes=12000000000"),  # one process has all of it in memory,
    *("--set", "training.pool_bytes=3000000000"),  # and keeps as many rays as workers do
)
_PROGRAM = "from triquad_tools.commands.map_recording import main; raise SystemExit(main())"
_POLL_S = 0.2


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return how long each takes, and how good the maps are."""
    drive = street_drive(
        options.seed, int(_LENGTH_M / _STEP_M), _STEP_M, _LENGTH_M, Lidar(columns=720)
    )
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as name:
        folder = Path(name)
        write_recording(folder / "scans", drive, drive.poses, "the recording")
        alone_s, alone_f = _mapped(folder, drive, [])
        figures = [
            Figure("one process", alone_s, "s"),
            Figure("one process: F", 100 * alone_f, "%"),
            Figure("its map file", (folder / "map.triquad").stat().st_size / 1e6, "MB"),
        ]
        for workers, kills in ((1, False), (2, False), (2, True)):
            took_s, f_score = _mapped(folder, drive, ["--workers", str(workers)], kills=kills)
            name = f"{workers} workers" + (", one killed amid it" if kills else "")
            figures += [
                Figure(f"{name}: of that", took_s / alone_s, ""),
                Figure(f"{name}: less F", 100 * (alone_f - f_score), "points", at_most=0.2),
            ]
        return figures


def _mapped(
    folder: Path, drive: SimulatedDrive, flags: Sequence[str], *, kills: bool = False
) -> tuple[float, float]:
    """Make a map; return the seconds that it took and its F-score."""
    output = folder / "map.triquad"
    command = [sys.executable, "-c", _PROGRAM, *_SETTINGS, *flags]
    started_s = time.monotonic()
    with _running([*command, "--force", str(folder / "scans"), str(output)]) as process:
        if kills:
            _kill_a_worker(process, folder)
        if process.wait() != 0:
            raise RuntimeError(f"triquad-map {' '.join(flags)} failed: {process.returncode}")
    took_s = time.monotonic() - started_s
    with open_map(output) as opened:
        pieces = np.arange(REACH_M, _LENGTH_M - REACH_M - PIECE_M, _EACH_M).tolist()
        return took_s, mean_f_score(drive, opened.mesh, pieces)


@contextmanager
def _running(command: Sequence[str]) -> Iterator["subprocess.Popen[bytes]"]:
    with subprocess.Popen(command) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.kill()


def _kill_a_worker(process: "subprocess.Popen[bytes]", folder: Path) -> None:
    """Kill the process that computes most, once a region is done."""
    while process.poll() is None and not list(folder.glob("*.parts/region*")):
        time.sleep(_POLL_S)
    workers = [pid for pid in _descendants(process.pid) if pid != process.pid]
    if workers:
        os.kill(max(workers, key=_computed), signal.SIGKILL)


def _descendants(pid: int) -> list[int]:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(one for child in children for one in _descendants(int(child)))]


def _computed(pid: int) -> int:
    """Return for how many ticks a process has computed."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11])
