"""A campaign: turns of all parts, two at a time, each in a process of its own, until time is up."""

import contextlib
import json
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

from bench.campaign.record import Record, TurnResult
from bench.campaign.table import markdown
from bench.campaign.turn import Part

_TURN_S = 600.0
"""A turn begins nothing new after that."""
_HANG_S = 300.0
"""A turn that has not ended so long after that hangs."""
_FIRST_SEED = 1
_ROOT = Path(__file__).parents[2]


class Campaign:
    """A campaign in a folder: what was done so far, and how to go on."""

    def __init__(self, folder: Path, parts: Sequence[Part]) -> None:
        """Go on with the campaign in ``folder``, or begin one."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._missing = {part.name: why for part in parts if (why := part.missing())}
        self._parts = [part for part in parts if part.name not in self._missing]
        self._record = Record.read(folder / "campaign.json")
        self._lock = threading.Lock()
        self._running: set[str] = set()
        self._children: set[subprocess.Popen[bytes]] = set()
        self._stopped = threading.Event()
        self._began_s = self._ends_s = 0.0

    @property
    def broken(self) -> int:
        """The number of promises that were not kept."""
        return sum(len(done.broken) for done in self._record.parts.values())

    def table(self) -> str:
        """Return what was done and what broke, in Markdown."""
        return markdown([*self._parts], self._record, self._missing)

    def run(self, seconds: float, lanes: int) -> None:
        """Run turns until the time is up; the part that is farthest from its goal comes next."""
        self._began_s = time.monotonic() - self._record.seconds
        self._ends_s = time.monotonic() + seconds
        try:
            with ThreadPoolExecutor(lanes) as pool:
                try:
                    running = [pool.submit(self._lane) for _ in range(lanes)]
                    for lane in running:
                        lane.result()
                except BaseException:
                    self._stop()
                    raise
        finally:
            self._save()

    def _save(self) -> None:
        with self._lock:
            self._record.seconds = time.monotonic() - self._began_s
            self._record.write()

    def _stop(self) -> None:
        """End the turns that run; they do not count."""
        self._stopped.set()
        for child in tuple(self._children):
            _kill(child)

    def _lane(self) -> None:
        while (part := self._next_part()) is not None:
            seed = self._record.of(part.name).turns + _FIRST_SEED
            left_s = max(1.0, self._ends_s - time.monotonic())
            result = self._turn(part, seed, min(left_s, _TURN_S))
            with self._lock:
                self._running.discard(part.name)
                if self._stopped.is_set():
                    return
                self._record.of(part.name).add(seed, result)
            self._save()
            self._tell(part, seed, result)

    def _next_part(self) -> Part | None:
        with self._lock:
            free = [part for part in self._parts if part.name not in self._running]
            if not free or self._stopped.is_set() or time.monotonic() >= self._ends_s:
                return None
            part = min(free, key=lambda part: self._record.of(part.name).done / part.goal)
            self._running.add(part.name)
            return part

    def _turn(self, part: Part, seed: int, seconds: float) -> TurnResult:
        """Run a turn in a process group of its own, which is killed if it hangs."""
        told = self._folder / f"{part.name}-{seed}.json"
        told.unlink(missing_ok=True)
        command = [sys.executable, "-m", "bench.campaign", "--part", part.name, "--seed", str(seed)]
        command += ["--minutes", str(seconds / 60), "--out", str(self._folder)]
        command += ["--result", str(told)]
        log = self._folder / f"{part.name}-{seed}.log"
        with log.open("wb") as output:
            child = subprocess.Popen(
                command,
                stdout=output,
                stderr=output,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": f"{_ROOT / 'tests'}:{_ROOT}"},
            )
            self._children.add(child)
            if self._stopped.is_set():  # before the turn was known to be one to end
                _kill(child)
            try:
                child.wait(seconds + _HANG_S)
                how = f"the turn ended with {child.returncode} and told nothing: {log}"
            except subprocess.TimeoutExpired:
                how = f"the turn hangs: {log}"
            finally:
                _kill(child)
                self._children.discard(child)
        if not told.exists():
            return TurnResult({}, {}, [how], seconds)
        result = TurnResult(**json.loads(told.read_text()))
        told.unlink()
        if not result.broken:
            log.unlink()
            shutil.rmtree(self._folder / f"{part.name}-{seed}", ignore_errors=True)
        return result

    def _tell(self, part: Part, seed: int, result: TurnResult) -> None:
        done = self._record.of(part.name).done
        broken = f"{len(result.broken)} BROKEN" if result.broken else "nothing broke"
        print(
            f"{part.name} --seed {seed}: {result.seconds:.0f} s, {broken}; "
            f"{done:,} of {part.goal:,} {part.unit}",
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
