"""Whatever happens to a map, a correction makes it as the scans with their better poses would."""

import shutil
from collections.abc import Callable
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support import servers
from support.maps.drifted import SCANS, SETTINGS, Array, off, shared, surface
from support.maps.small_world import world
from support.poses import shifted
from triquad_client import RefusedError
from triquad_format.scan_log.log_folder import segments
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_server.store.store import Store
from triquad_tools.recordings.opening import open_recording
from triquad_tools.recordings.recording import ReadingOptions

STEPS = 14
ALIKE = 0.93  # walls in two places vanish a little otherwise where a map was restored between
BOX = (np.array([-3.0, -20.0, -5.0]), np.array([3.0, 20.0, 9.0]))
SOURCES = "roof", "front"
RIGHT = shifted()
SMALL_REGIONS = replace(SETTINGS.field, depth=8)  # of 51 m


@dataclass
class TakenScan:
    """A scan that the map has."""

    number: int  # of the drive
    source: str
    stamp_s: float
    pose: Array
    start: int  # how often the source's time began again before


@dataclass
class Model:
    """What a map should have been made of."""

    events: list[TakenScan | tuple[Array, Array]] = field(default_factory=list)

    def scans(self, source: str) -> list[TakenScan]:
        """The scans of a source since its time began the last time."""
        found = [one for one in self.events if isinstance(one, TakenScan) and one.source == source]
        return [one for one in found if one.start == found[-1].start]

    def correct(self, stamps_s: list[float], poses: list[Array], *, onward: bool, source: str):
        """Have scans where they should be; there is one at each of the stamps."""
        scans = self.scans(source)
        before = {one.stamp_s: one.pose for one in reversed(scans)}
        better = dict(zip(stamps_s, poses, strict=True))
        end = np.linalg.inv(before[stamps_s[-1]]) @ poses[-1]
        for one in scans:
            if one.stamp_s in better:
                one.pose = one.pose @ np.linalg.inv(before[one.stamp_s]) @ better[one.stamp_s]
            elif onward and one.stamp_s > stamps_s[-1]:
                one.pose = one.pose @ end

    def surface(self, settings: Settings) -> Array:
        mapper = Mapper("truth", settings, "cpu")
        for one in self.events:
            if isinstance(one, TakenScan):
                scan = world(SCANS).scans[one.number]
                mapper.ingest(scan.points, one.pose, no_return=scan.no_return)
            else:
                mapper.reset(*one)
        with triquad_client.OfflineMap(mapper.publish().record()) as done:
            return done.surface_voxels()


class Life:
    """A map to which things happen, and what it should be."""

    def __init__(self, folder: Path, seed: int) -> None:
        # In every other life the map has several regions, and a correction makes some of them.
        self.settings = SETTINGS if seed % 2 else SETTINGS.with_field(SMALL_REGIONS)
        self.rng = np.random.default_rng(seed)
        self.folder, self.lives = folder, 0
        self.model = Model()
        self.saved: dict[int, Model] = {0: Model()}  # by epoch
        self.stamp_s = dict.fromkeys(SOURCES, 1e9)
        self.numbers = dict.fromkeys(SOURCES, 0)  # of the last scan of each
        self.start = dict.fromkeys(SOURCES, 0)
        self.restored = 0  # to which epoch, the last time: a second time changes nothing
        self.is_cut = False  # whether the oldest scans are kept no more
        self.told: list[str] = []
        self.stack = ExitStack()
        self.open()

    @property
    def store(self) -> Path:
        return self.folder / f"store-{self.lives}"

    def close(self) -> None:
        """Stop the server, which writes what it has."""
        self.stack.close()
        self.saved[max(self.epochs(), default=0)] = deepcopy(self.model)

    def open(self) -> None:
        self.client = self.stack.enter_context(
            servers.service_and_client(self.settings, self.store)
        )

    def publish(self) -> None:
        source = str(self.rng.choice(SOURCES))
        error = [RIGHT, off(), off(0.5)][self.rng.integers(3)]
        number = (self.numbers[source] + int(self.rng.integers(1, SCANS))) % SCANS
        self.stamp_s[source] += float(self.rng.choice([0.25, 1.0, 3.0]))
        for _ in range(int(self.rng.integers(1, 3))):  # it may rest, and each is kept
            self.stamp_s[source] += 2.0
            self.add(source, number, self.stamp_s[source], error)

    def add(self, source: str, number: int, stamp_s: float, error: Array) -> None:
        scan = world(SCANS).scans[number]
        pose, self.numbers[source] = scan.world_from_sensor @ error, number
        self.client.publish_scan(scan.points, pose, stamp_s, source, no_return=scan.no_return)
        assert self.client.flush().refused == 0
        self.model.events.append(TakenScan(number, source, stamp_s, pose, self.start[source]))
        self.told[-1] += f" {number} of {source} at {stamp_s - 1e9:g} off {error[1, 3]:g}"

    def begin_again(self) -> None:
        source = str(self.rng.choice(SOURCES))
        if not self.of_model(source):
            return
        self.client.restart_source(source)
        self.stamp_s[source] = self.model.scans(source)[0].stamp_s - float(self.rng.choice([2, 50]))
        self.start[source] += 1
        number = (self.numbers[source] + 1) % SCANS
        self.add(source, number, self.stamp_s[source], off())

    def of_model(self, source: str) -> bool:
        return any(isinstance(one, TakenScan) and one.source == source for one in self.model.events)

    def correct(self) -> None:
        source = str(self.rng.choice(SOURCES))
        if not self.of_model(source):
            return
        scans = {one.stamp_s: one for one in reversed(self.model.scans(source))}
        stamps_s = sorted(scans)
        first, last = sorted(self.rng.integers(0, len(stamps_s), 2).tolist())
        stamps_s = stamps_s[first : last + 1]
        right = [RIGHT, RIGHT, off(0.7)][self.rng.integers(3)]
        poses = [world(SCANS).scans[scans[at].number].world_from_sensor @ right for at in stamps_s]
        onward = bool(self.rng.integers(2))
        self.told[-1] += f" {source} {np.array(stamps_s) - 1e9} to {right[1, 3]:g} onward {onward}"
        before = deepcopy(self.model)
        try:
            reply = self.client.correct_poses(source, stamps_s, poses, onward=onward)
        except RefusedError as error:  # what it takes is kept no more, which must be told
            if not self.is_cut or error.code not in {"store", "bad_request"}:
                raise
            self.saved[max(self.epochs())] = before
            return
        self.saved[reply.kept_epoch or reply.epoch] = before
        self.model.correct(stamps_s, poses, onward=onward, source=source)
        self.saved[max(self.epochs())] = deepcopy(self.model)
        self.told[-1] += f": {reply.scans_moved} moved, {reply.scans_learnt} learnt"

    def reset(self) -> None:
        before = deepcopy(self.model)
        kept = self.client.reset(BOX).kept_epoch
        self.saved |= {} if kept is None else {kept: before}
        self.model.events.append(BOX)

    def cut(self) -> None:
        """Delete the oldest of the log, as where it has no room for more."""
        files = segments(next(self.store.glob("*/scans")))
        for file in files[: min(len(files) - 1, int(self.rng.integers(1, 4)))]:
            file.path.unlink()
            self.is_cut = True

    def checkpoint(self) -> None:
        self.saved[self.client.checkpoint().epoch] = deepcopy(self.model)

    def restart(self) -> None:
        self.close()
        self.open()
        self.check()

    def kill(self) -> None:
        """Go on with the files as they are now, as a server that was killed."""
        shutil.copytree(self.store, self.folder / f"store-{self.lives + 1}")
        self.stack.close()
        self.lives += 1
        self.go_back(max(self.epochs(), default=0))
        self.open()
        self.check()

    def restore(self) -> None:
        self.close()
        epochs = [epoch for epoch in self.epochs() if epoch != self.restored]
        epoch = self.restored = int(self.rng.choice(epochs))
        store = Store(self.store, servers.MAP, self.settings.store)
        store.restore(epoch)
        store.close()
        self.go_back(epoch)
        self.saved[max(self.epochs())] = deepcopy(self.model)
        self.told[-1] += f" {epoch}"
        self.open()
        self.check()

    def epochs(self) -> list[int]:
        return [int(path.name[6:15]) for path in self.store.glob("*/epoch-*") if path.is_file()]

    def go_back(self, epoch: int) -> None:
        self.model = deepcopy(self.saved[epoch])
        for source in SOURCES:
            if self.of_model(source):
                self.start[source] = self.model.scans(source)[0].start
                # A publisher's clock goes on.

    def check(self) -> None:
        """Hold the map, and the poses that the server has kept, against what they should be."""
        self.checkpoint()
        found, expected = surface(self.client, self.folder), self.model.surface(self.settings)
        share = shared(found, expected) if len(found) and len(expected) else 0.0
        told = "\n".join([*self.told, f"{share:.4f}"])
        assert share > ALIKE or len(found) == len(expected) == 0, told
        scans = [one for one in self.model.events if isinstance(one, TakenScan)]
        if scans:
            kept = open_recording(self.store, ReadingOptions())
            assert len(kept) == len(scans) or self.is_cut, told
            scans = scans[len(scans) - len(kept) :]
            for one, scan in zip(kept.read(range(len(kept))), scans, strict=True):
                np.testing.assert_allclose(
                    one.world_from_sensor, scan.pose, atol=1e-6, err_msg=told
                )

    def live(self) -> None:
        """Have things happen."""
        acts: list[tuple[Callable[[], None], int]] = [
            *((self.publish, 8), (self.correct, 6), (self.checkpoint, 2), (self.reset, 1)),
            *((self.restart, 1), (self.kill, 1), (self.restore, 1), (self.begin_again, 1)),
            (self.cut, 1),
        ]
        weights = np.array([weight for _, weight in acts], float)
        for _ in range(STEPS):
            act = acts[self.rng.choice(len(acts), p=weights / weights.sum())][0]
            self.told.append(act.__name__)
            act()
        self.told.append("at last")
        self.check()


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(2, 40))]
)
def test_a_map_is_what_its_scans_make_of_it(tmp_path: Path, seed: int) -> None:
    life = Life(tmp_path, seed)
    with life.stack:
        life.live()
