"""A campaign: turns of all parts, each in a process of its own, until time is up."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bench.campaign.record import TurnResult, results, table
from bench.campaign.turn import Part

_TURN_S = 600.0
"""A turn begins nothing new after that."""
_HANG_S = 300.0
"""A turn that has not ended so long after that hangs."""
_ROOT = Path(__file__).parents[2]


class Campaign:
    """A campaign in a folder, which has the results of all turns so far."""

    def __init__(self, folder: Path, parts: Sequence[Part]) -> None:
        """Go on with the campaign in ``folder``, or begin one."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._missing = {part.name: why for part in parts if (why := part.missing())}
        self._parts = [part for part in parts if part.name not in self._missing]

    @property
    def broken(self) -> int:
        """The number of promises that were not kept."""
        found = (results(self._folder, part) for part in self._parts)
        return sum(len(turn.broken) for turns in found for turn in turns)

    def table(self) -> str:
        """Return what was done and what broke, in Markdown."""
        return table(self._parts, self._folder, self._missing)

    def run(self, seconds: float) -> None:
        """Run turns until the time is up; the part that is farthest from its goal comes next."""
        ends_s = time.monotonic() + seconds
        while self._parts and (left_s := ends_s - time.monotonic()) > 0:
            part = min(self._parts, key=lambda part: self._done(part) / part.goal)
            seeds = (turn.seed for turn in results(self._folder, part))
            self._turn(part, 1 + max(seeds, default=0), min(max(left_s, 1.0), _TURN_S))

    def _done(self, part: Part) -> int:
        return sum(turn.done for turn in results(self._folder, part))

    def _turn(self, part: Part, seed: int, seconds: float) -> None:
        """Run a turn in a process group of its own, which is killed if it hangs, and report it."""
        log = self._folder / f"{part.name}-{seed}.log"
        how = self._run(part, seed, seconds, log)
        written = log.with_suffix(".json")
        if not written.exists():
            TurnResult(seed, {}, {}, [f"{how}: {log}"], seconds).write(written)
        result = TurnResult.read(written)
        if not result.broken:
            log.unlink()
            shutil.rmtree(self._folder / f"{part.name}-{seed}", ignore_errors=True)
        self._tell(part, seed, result)

    def _run(self, part: Part, seed: int, seconds: float, log: Path) -> str:
        """Wait until the process of a turn has ended; return how it ended."""
        command = [sys.executable, "-m", "bench.campaign", "--part", part.name, "--seed", str(seed)]
        command += ["--minutes", str(seconds / 60), "--out", str(self._folder)]
        environment = {**os.environ, "PYTHONPATH": f"{_ROOT / 'tests'}:{_ROOT}"}
        with log.open("wb") as output:
            child = subprocess.Popen(
                command, stdout=output, stderr=output, start_new_session=True, env=environment
            )
        try:
            return f"the turn ended with {child.wait(seconds + _HANG_S)} and told nothing"
        except subprocess.TimeoutExpired:
            return "the turn hangs"
        finally:  # with all processes that it left
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()

    def _tell(self, part: Part, seed: int, result: TurnResult) -> None:
        broken = f"{len(result.broken)} BROKEN" if result.broken else "nothing broke"
        print(
            f"{part.name} --seed {seed}: {result.seconds:.0f} s, {broken}; "
            f"{self._done(part):,} of {part.goal:,} {part.unit}",
            flush=True,
        )
        for text in result.broken[:3]:
            print(f"  {text:.500}", flush=True)
        if result.broken:
            command = f"{sys.executable} -m bench.campaign --part {part.name} --seed {seed}"
            print(f"  again: PYTHONPATH=tests {command}", flush=True)
