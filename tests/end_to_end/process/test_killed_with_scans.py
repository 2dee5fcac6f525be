"""SIGKILL while scans stream, checkpoints are written and poses corrected: what a reply said stays.

Of each scan the model has the lane, which tells its place: ``roof`` drives on and on, and its scans
are moved to other lanes; ``front`` comes to the same few places again and again.
"""

import contextlib
import random
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import triquad_client
from support import servers
from support.poses import shifted
from triquad_client import Client, RefusedError, Status, TriquadError
from triquad_tools.recordings.scan_log import find_scan_log, read_scan_log

FIRST_S = 1e9  # the stamp of the first scan of each source; the others come a second apart each
APART_M = 9.0  # of places on a lane, and of lanes: more than the spheres' diameters
LANES = 4  # of the roof
FRONT_LANE, FRONT_PLACES = -2, 6
SOON_S, LATER_S = 2.0, 8.0  # until a kill, at most, since the load began
STARTING_S = 4.0  # of a kill of a server that starts
POINTS = servers.sphere(400)
ARGUMENTS = ["--settings", servers.SMALL_FILE, "--set", "store.log_max_bytes=1000000000"]
ARGUMENTS += ["--set", "store.period_s=0.3", "--set", "store.keep=4"]

Lanes = dict[str, list[int]]


def pose_of(source: str, number: int, lane: int) -> np.ndarray:
    place = number if source == "roof" else number % FRONT_PLACES
    return shifted(APART_M * place, APART_M * lane)


class Promises:
    """What was published, and what replies have promised to keep of it."""

    def __init__(self) -> None:
        self.lanes: Lanes = {"roof": [], "front": []}  # of the scans of each source
        self.mapped = {"roof": 0, "front": 0}  # scans, as a flush has said
        self.kept = {"roof": 0, "front": 0}  # scans, as a checkpoint or a correction has said
        self.wanted: list[int] | None = None  # the roof's lanes by a correction under way

    def hold(self, found: Lanes, told: str) -> None:
        """See that all is there that was promised, and nothing that was never published."""
        for source, lanes in found.items():
            known = [self.lanes[source]]
            known += [self.wanted] if self.wanted is not None and source == "roof" else []
            assert self.kept[source] <= len(lanes) <= len(self.lanes[source]), (told, source)
            assert any(lanes == one[: len(lanes)] for one in known), (told, source, lanes, known)

    def go_on_from(self, found: Lanes) -> None:
        """Take what is there for what is published, as the server that goes on from it does."""
        self.lanes, self.wanted = found, None
        self.kept = {source: len(lanes) for source, lanes in found.items()}
        self.mapped = self.kept.copy()


def logged(store: Path) -> Lanes:
    """The scans that the log has, as ``triquad-map`` reads them."""
    folder, found = find_scan_log(store), Lanes(roof=[], front=[])
    if folder is None:
        return found
    recording = read_scan_log(folder)
    scans = recording.read(range(len(recording)))
    for entry, scan in zip(recording.entries, scans, strict=True):
        number, lane = len(found[entry.source]), round(scan.world_from_sensor[1, 3] / APART_M)
        assert entry.stamp_ns == (FIRST_S + number) * 1e9
        np.testing.assert_allclose(
            scan.world_from_sensor, pose_of(entry.source, number, lane), atol=1e-6
        )
        found[entry.source].append(lane)
    return found


def assert_mapped(client: Client, found: Lanes) -> None:
    """The map has the scans of the log where that has them, and nowhere else."""
    assert client.status().scans_taken == sum(map(len, found.values()))
    for number, own in enumerate(found["roof"]):
        for lane in range(LANES):
            points = POINTS[::10] + pose_of("roof", number, lane)[:3, 3]
            share = (client.query_sdf(points).status == Status.SURFACE).mean()
            assert share == pytest.approx(float(lane == own), abs=0.05), (number, lane, own)
    for number in range(min(FRONT_PLACES, len(found["front"]))):
        points = POINTS[::10] + pose_of("front", number, FRONT_LANE)[:3, 3]
        assert (client.query_sdf(points).status == Status.SURFACE).mean() > 0.95, number


class Load(threading.Thread):
    """One of the two who publish to a server, until it is killed."""

    def __init__(self, endpoint: str, promises: Promises, draws: random.Random, source: str):
        super().__init__(name=source)
        self._endpoint, self._promises, self._source = endpoint, promises, source
        self._draws = random.Random(draws.random())
        self.broken: Exception | None = None

    def run(self) -> None:
        try:
            with triquad_client.connect(self._endpoint, timeout_s=10.0) as client:
                while True:
                    self._publish(client)
                    if self._source == "roof":
                        self._have_kept(client)
        except RefusedError as error:
            self.broken = error
        except TriquadError:
            return  # the server was killed
        except Exception as error:
            self.broken = error

    def _publish(self, client: Client) -> None:
        lanes = self._promises.lanes[self._source]
        for _ in range(self._draws.randint(1, 3)):
            lane = self._draws.randrange(LANES) if self._source == "roof" else FRONT_LANE
            number = len(lanes)
            lanes.append(lane)
            pose = pose_of(self._source, number, lane)
            client.publish_scan(POINTS, pose, FIRST_S + number, self._source)
        report = client.flush()
        assert report.lost == report.refused == 0, report
        self._promises.mapped[self._source] = len(lanes)

    def _have_kept(self, client: Client) -> None:
        """Have a checkpoint written or poses corrected: the reply promises all that was mapped."""
        promises, mapped = self._promises, self._promises.mapped.copy()
        if self._draws.random() < 0.6:
            client.checkpoint()
        else:
            lanes = promises.lanes["roof"]
            first, last = sorted(self._draws.choices(range(len(lanes)), k=2))
            moved = [self._draws.randrange(LANES) for _ in range(first, last + 1)]
            promises.wanted = lanes[:first] + moved + lanes[last + 1 :]
            poses = [pose_of("roof", first + n, lane) for n, lane in enumerate(moved)]
            stamps_s = [FIRST_S + number for number in range(first, last + 1)]
            client.correct_poses("roof", stamps_s, poses)
            promises.lanes["roof"], promises.wanted = promises.wanted, None
        promises.kept = mapped


@contextlib.contextmanager
def server_on(store: Path, *, ready: bool = True) -> Iterator[servers.ServerProcess]:
    with servers.server_process([*ARGUMENTS, "--store", store], ready=ready) as server:
        yield server
    assert "Traceback" not in server.log, server.log
    assert not list(store.rglob("*.damaged")), server.log


def kill_within(server: servers.ServerProcess, seconds: float) -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        server.process.wait(seconds)
    server.process.kill()
    server.wait()


def live_and_die(store: Path, promises: Promises, draws: random.Random, told: str) -> None:
    """Start a server, see what it has, and kill it under load."""
    if draws.random() < 0.2:
        with server_on(store, ready=False) as server:
            kill_within(server, draws.uniform(0, STARTING_S))
        promises.hold(logged(store), f"{told}, killed as it started")
    with server_on(store) as server:
        check(server.endpoint, store, promises, told)
        loads = [Load(server.endpoint, promises, draws, source) for source in promises.lanes]
        for load in loads:
            load.start()
        kill_within(server, draws.uniform(0, draws.choice([SOON_S, LATER_S])))
        for load in loads:
            load.join()
            assert load.broken is None, (told, load.broken)
    promises.hold(logged(store), f"{told}, killed")


def check(endpoint: str, store: Path, promises: Promises, told: str) -> None:
    """See what a server has that was started, and go on from it."""
    with triquad_client.connect(endpoint) as client:
        found = logged(store)
        promises.hold(found, f"{told}, started again")
        assert_mapped(client, found)
        promises.go_on_from(found)


@pytest.mark.parametrize(
    ("seed", "kills"),
    [(68, 3), *(pytest.param(seed, 10, marks=pytest.mark.long) for seed in range(1, 11))],
)
def test_whenever_the_server_is_killed_what_was_acknowledged_is_there(tmp_path, seed, kills):
    draws, promises, store = random.Random(seed), Promises(), tmp_path / "store"
    for number in range(kills):
        live_and_die(store, promises, draws, f"life {number} of seed {seed}")
    with server_on(store) as server:
        check(server.endpoint, store, promises, "at last")
        with triquad_client.connect(server.endpoint) as client:
            count = len(promises.lanes["roof"])
            poses = [pose_of("roof", number, 0) for number in range(count)]
            client.correct_poses("roof", [FIRST_S + number for number in range(count)], poses)
            assert_mapped(client, promises.lanes | {"roof": [0] * count})
        server.process.terminate()
        assert server.wait() == 0
