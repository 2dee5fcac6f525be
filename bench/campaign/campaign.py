"""A campaign: turns of all parts, two at a time, each in a process of its own, until time is up."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
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
        self._lock = threading.Lock()
        self._running: set[str] = set()
        self._children: set[subprocess.Popen[bytes]] = set()
        self._stopped = threading.Event()
        self._ends_s = 0.0

    @property
    def broken(self) -> int:
        """The number of promises that were not kept."""
        return sum(len(turn.broken) for part in self._parts for turn in self._results(part))

    def table(self) -> str:
        """Return what was done and what broke, in Markdown."""
        return table(self._parts, self._folder, self._missing)

    def run(self, seconds: float, lanes: int) -> None:
        """Run turns until the time is up; the part that is farthest from its goal comes next."""
        self._ends_s = time.monotonic() + seconds
        with ThreadPoolExecutor(lanes) as pool:
            try:
                for lane in [pool.submit(self._lane) for _ in range(lanes)]:
                    lane.result()
            except BaseException:
                self._stop()
                raise

    def _results(self, part: Part) -> list[TurnResult]:
        return results(self._folder, part)

    def _done(self, part: Part) -> int:
        return sum(turn.done for turn in self._results(part))

    def _stop(self) -> None:
        """End the turns that run; they do not count."""
        self._stopped.set()
        for child in tuple(self._children):
            _kill(child)

    def _lane(self) -> None:
        while (part := self._next_part()) is not None:
            seed = 1 + max((turn.seed for turn in self._results(part)), default=0)
            left_s = max(1.0, self._ends_s - time.monotonic())
            result = self._turn(part, seed, min(left_s, _TURN_S))
            if result is not None:
                self._tell(part, seed, result)
            with self._lock:
                self._running.discard(part.name)

    def _next_part(self) -> Part | None:
        with self._lock:
            free = [part for part in self._parts if part.name not in self._running]
            if not free or self._stopped.is_set() or time.monotonic() >= self._ends_s:
                return None
            part = min(free, key=lambda part: self._done(part) / part.goal)
            self._running.add(part.name)
            return part

    def _turn(self, part: Part, seed: int, seconds: float) -> TurnResult | None:
        """Run a turn in a process group of its own, which is killed if it hangs.

        ``None``: it was stopped.
        """
        log = self._folder / f"{part.name}-{seed}.log"
        how = self._run(part, seed, seconds, log)
        written = log.with_suffix(".json")
        if self._stopped.is_set():
            written.unlink(missing_ok=True)
            return None
        if not written.exists():
            TurnResult(seed, {}, {}, [f"{how}: {log}"], seconds).write(written)
        result = TurnResult.read(written)
        if not result.broken:
            log.unlink()
            shutil.rmtree(self._folder / f"{part.name}-{seed}", ignore_errors=True)
        return result

    def _run(self, part: Part, seed: int, seconds: float, log: Path) -> str:
        """Wait until the process of a turn has ended; return how it ended."""
        command = [sys.executable, "-m", "bench.campaign", "--part", part.name, "--seed", str(seed)]
        command += ["--minutes", str(seconds / 60), "--out", str(self._folder)]
        environment = {**os.environ, "PYTHONPATH": f"{_ROOT / 'tests'}:{_ROOT}"}
        with log.open("wb") as output:
            child = subprocess.Popen(
                command, stdout=output, stderr=output, start_new_session=True, env=environment
            )
        self._children.add(child)
        if self._stopped.is_set():  # before the turn was known to be one to end
            _kill(child)
        try:
            return f"the turn ended with {child.wait(seconds + _HANG_S)} and told nothing"
        except subprocess.TimeoutExpired:
            return "the turn hangs"
        finally:
            _kill(child)
            self._children.discard(child)

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


def _kill(child: "subprocess.Popen[bytes]") -> None:
    """End a turn and all processes that it left."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()
