"""Compiles all kernels of a server before it is ready, using a small synthetic map.

That takes half a minute or more, once per machine and release, in two processes of their own: on
both cores, and the compiler's memory goes with them. From then on the compiled code is found on
disk. ``python -m triquad_server.warm_up`` does it without starting a server.
"""

import gc
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import Any

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_map.compiled.kernel import CODE_FOLDER, count_compiled
from triquad_map.field.frozen_field import field_samples
from triquad_map.questions.distance import distances

from triquad_server.engine.compiled_trainer import trainer_of
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.live_field import Batch, initial_field
from triquad_server.engine.memory import memory_on
from triquad_server.intake.rays import ScanRays
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import TileCache
from triquad_server.process.threads import Teams
from triquad_server.settings import MemorySettings, Settings

_COMPILING = "compiling, %s; in all half a minute or more, once per machine and release"
_COMMAND = [sys.executable, "-m", "triquad_server.warm_up"]
_DONE = "complete"  # the file that says that nothing is missing among the compiled code
_OF_FIELD = "field"  # the argument of the process that compiles what needs no map
_REMOVING_SCANS = 6  # scans of rays that pass the synthetic sphere, until it is removed
_DIRECTIONS = 400  # of the rays of a synthetic scan
_RADIUS_M = 3.0  # of the sphere that it sees

_log = logging.getLogger("triquad_server")

Report = Callable[[str], None]
"""Receives the name of each step before it begins."""


def warm_up(
    settings: Settings, device: str, teams: Teams | None = None, report: Report = lambda _: None
) -> None:
    """Compile all kernels, or load compiled ones; what ``report`` raises ends the work."""
    _log.info("preparing compiled code")
    if CODE_FOLDER is not None and not (CODE_FOLDER / _DONE).exists():
        _compile_apart(report)
    before = count_compiled()
    for name, step in _SyntheticMap(settings, device, teams or Teams()).steps():
        report(name)
        if CODE_FOLDER is None or count_compiled() > before:
            _log.warning(_COMPILING, name)
        go_through(step)


def go_through(step: Callable[[], None]) -> None:
    """Go through a step, and again without the code on disk if that cannot be used."""
    was_enabled = gc.isenabled()
    gc.disable()  # most of what compiling makes stays; it takes a sixth less time
    try:
        step()
    except Exception:  # of any kind, where a power cut has left a file half written
        if CODE_FOLDER is None:
            raise
        _log.warning("compiled code in %s may be damaged: made again", CODE_FOLDER, exc_info=True)
        shutil.rmtree(CODE_FOLDER, ignore_errors=True)
        step()
    finally:
        if was_enabled:
            gc.enable()


def _compile_apart(report: Report) -> None:
    """Compile all kernels in other processes; what they leave undone is compiled in this one."""
    # In a group of its own, which interrupts from the keyboard do not reach, and whatever modules
    # lie in the folder where the server was started.
    safe = {**os.environ, "PYTHONSAFEPATH": "1"}
    options: Any = {"stdout": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(_COMMAND, env=safe, **options) as process:
        try:
            for line in process.stdout or ():
                report(line.strip())
                _log.warning(_COMPILING, line.strip())
        except BaseException:  # the start is given up
            os.killpg(process.pid, signal.SIGTERM)
            raise


def _compile() -> None:
    """Compile all kernels, those of a field in a second process; print each step."""
    with subprocess.Popen([*_COMMAND, _OF_FIELD]) as field:
        for name, step in _SyntheticMap(Settings(), "cpu", Teams()).steps():
            sys.stdout.write(name + "\n")
            sys.stdout.flush()  # who started this process shows it
            go_through(step)
            field.wait()  # from the second step on, its kernels are called
    if CODE_FOLDER is not None:
        (CODE_FOLDER / _DONE).touch()


def _compile_field() -> None:
    """Train a field by itself, and question it."""
    settings, teams, generator = Settings().field, Teams(), np.random.default_rng(0)
    field = initial_field(settings, memory_on("cpu"), seed=0)
    field.grow(generator.integers(0, 1 << settings.depth, (_DIRECTIONS, 3)))
    points = generator.normal(size=(_DIRECTIONS, 3)).astype(np.float32)
    trainer = trainer_of(field, GradientSums(), teams.mapping)
    trainer.train(Batch(points, points[:, 0]), 0.01)
    field_samples(field.freeze(), settings, teams.mapping.split)(points.astype(float))
    field.live_view().evaluate_in_grid(points.T.copy(), np.zeros((1, 3), np.int64))


class _SyntheticMap:
    """Maps a sphere, queries it, meshes it and removes it: each step uses some kernels."""

    def __init__(self, settings: Settings, device: str, teams: Teams) -> None:
        # With room for it, whatever the memory limit of the map itself.
        self._settings = settings.model_copy(update={"memory": MemorySettings()})
        self._teams = teams
        scan = settings.scan
        directions = np.random.default_rng(0).normal(size=(min(_DIRECTIONS, scan.max_points), 3))
        self._directions: Doubles = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        self._radius_m = min(max(_RADIUS_M, scan.range_min_m), scan.range_max_m)
        self._map_of = partial(Mapper, "warm-up", self._settings, device, teams=teams)
        self._mapper = self._map_of()

    def steps(self) -> Iterator[tuple[str, Callable[[], None]]]:
        """Yield each step with its number and name; the first one needs no field."""
        steps = (
            self.scans,
            self.training,
            self.questions,
            self.meshes,
            self.restored_training,
            self.removal,
        )
        for number, step in enumerate(steps, start=1):
            yield f"step {number} of {len(steps)}: {step.__name__.replace('_', ' ')}", step

    @cached_property
    def _restored(self) -> Mapper:
        return self._map_of(record=self._mapper.snapshot_since(None).record())

    def scans(self) -> None:
        """Take in a scan of the sphere."""
        rays = self._ingest(self._radius_m)
        next(iter(self._mapper.regions)).growth_by(rays)

    def training(self) -> None:
        """Train the map."""
        self._mapper.publish()
        self._mapper.train()
        self._mapper.publish()

    def questions(self) -> None:
        """Query the map while it learns, and the restored one for distances."""
        epoch = self._restored.publish()
        points = self._directions * self._radius_m
        self._mapper.publish().query(points, gradient=True)
        epoch.query(points, gradient=True)
        distances(epoch, points, unknown_distance=True)

    def meshes(self) -> None:
        """Make a tile of its mesh."""
        cache = TileCache(self._settings.mesh, self._teams.background)
        epoch = self._restored.publish()
        cache.refresh(epoch)
        # A field that learnt so little may have no face in a tile.
        epoch.near_ends(self._directions * self._radius_m, self._settings.mesh.reach_m)
        end_m = self._directions[0] * self._radius_m
        x, y, z = np.floor(end_m / cache.lattice(0).tile_side_m).astype(int).tolist()
        cache.make(0, (x, y, z))

    def restored_training(self) -> None:
        """Train the map further, as one that is restored and then seen again."""
        (region, *_) = self._restored.regions
        pool = region.training.rays.pool
        region.field.live_view().evaluate(self._directions.astype(np.float32), gradient=True)
        self._restored.train()
        pool.limit(len(pool) - 1)
        new = np.arange(len(pool)) < len(pool) // 4
        pool.add(pool.table.of(new))  # in place of others

    def removal(self) -> None:
        """Have rays pass the sphere until it is removed."""
        for _ in range(_REMOVING_SCANS):
            self._ingest(2 * self._radius_m)
        self._mapper.publish()

    def _ingest(self, radius_m: float) -> ScanRays:
        return self._mapper.ingest((self._directions * radius_m).astype(np.float32), np.eye(4))


if __name__ == "__main__":
    (_compile_field if sys.argv[1:] == [_OF_FIELD] else _compile)()
