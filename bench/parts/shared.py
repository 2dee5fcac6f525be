"""A map that four servers share, and the same by one: one is killed, and another one joins."""

import argparse
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from triquad_client import Client, connect
from triquad_client.net.shared_connection import SharedConnection
from triquad_format.errors import TriquadError
from triquad_format.records.arrays import Bools, Doubles, Floats
from triquad_format.wire.shares import share_name
from triquad_tools.recordings.publishing import wait_until_settled
from triquad_tools.simulation.lidar import Lidar

from bench.clients.server_process import ServerProcess, free_endpoint, server_process
from bench.driven import Driven, driven
from bench.figures import Figure
from bench.scenes.block import block_drive

_MAP = "town"
_SERVERS = 4
_SIDE_M, _SCANS, _STEP_M = 120.0, 200, 2.4  # once around a block
_AHEAD = 4  # scans that may be under way: each server takes all
_VOXEL_M = 0.05
_SETTINGS = (
    *("--set", "field.depth=8", "--set", "store.period_s=10"),  # regions of 51 m
    *("--set", "training.samples_per_ray=6"),  # of 48: it need not take an hour
)
_POINTS, _NEAR_M, _REACH_M = 20_000, 5.0, 5.0
_AROUND_M = 40.0  # of the last scan
_SEEN_S = 2.0  # until each has seen the checkpoints of the others
_ASKED, _PAUSE_S = 300, 0.1  # points at random over all, by a client amid it
_TIMEOUT_S, _SETTLED_S = 60.0, 1800.0


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return how the map is learnt by one and by four, and what coming and going does."""
    drive = block_drive(options.seed, _SIDE_M, _SCANS, _STEP_M, Lidar())
    block = driven(drive, _VOXEL_M, "a drive around a block")
    points = _points(block, options.seed)
    with server_process(["--map", _MAP, *_SETTINGS]) as server, _client([server]) as client:
        drive_s = _drive(client, block)
        alone = _Settled(client, block, points)
    with _several() as group, _client(group.servers[::-1]) as client:
        with _asking(client, points) as asked:
            shared_s = _drive(client, block)
            stale_m = _stale(group, client, block, points)
            four = _Settled(client, block, points)
        off = np.abs(four.distances - alone.distances)
        near = _near_borders(points, four.pitch_m)
        figures = [
            Figure("regions", four.regions, ""),
            Figure("one server: F", 100 * alone.f_score, "%"),
            Figure("four: less F", 100 * (alone.f_score - four.f_score), "points", at_most=0.2),
            Figure("four: time of the drive, of one's", shared_s / drive_s, ""),
            Figure("distances off those of one, which learnt apart: median",
                   1e3 * float(np.median(off)), "mm"),
            Figure("near borders: median", 1e3 * float(np.median(off[near])), "mm"),
            Figure("near borders, around the robot, off where one server is asked alone: 99 %",
                   1e3 * stale_m, "mm"),
            Figure("a client amid it: errors", asked.errors, "", at_most=0),
        ]  # fmt: skip
        client.checkpoint(_SETTLED_S)
        return [*figures, *_killed(group, client, points), *_joined(group, client, points)]


@dataclass
class _Group:
    """Servers that share a map."""

    store: Path
    stack: ExitStack
    endpoints: list[str]
    servers: list[ServerProcess]

    def start(self, endpoint: str) -> ServerProcess:
        """Start a server, which connects to all others."""
        links = [word for one in self.endpoints if one != endpoint for word in ("--connect", one)]
        words = ["--map", _MAP, "--share", "--store", str(self.store), *_SETTINGS, *links]
        return self.stack.enter_context(server_process(words, endpoint))


@contextmanager
def _several() -> Iterator[_Group]:
    with tempfile.TemporaryDirectory(prefix="triquad-bench-") as folder, ExitStack() as stack:
        group = _Group(Path(folder), stack, [free_endpoint() for _ in range(_SERVERS)], [])
        group.servers += map(group.start, group.endpoints)
        yield group


@contextmanager
def _client(servers: Sequence[ServerProcess], name: str = _MAP) -> Iterator[Client]:
    endpoints = ",".join(server.endpoint for server in servers)
    with connect(endpoints, name, timeout_s=_TIMEOUT_S) as client:
        yield client


class _Settled:
    """A map once it has settled."""

    def __init__(self, client: Client, block: Driven, points: Doubles) -> None:
        """Wait for it, and score it."""
        wait_until_settled(client, _SETTLED_S)
        if client.status().last_checkpoint is not None:
            # One server makes the mesh of all, of others' regions as their checkpoints have them.
            client.checkpoint(_SETTLED_S)
            time.sleep(_SEEN_S)
        self.f_score = block.mesh_scores(client.mesh(block.drive.scene.box)).f_score
        self.distances = _distances(client, points)
        status = client.status()
        self.regions, self.pitch_m = status.regions, status.region_pitch_m


def _drive(client: Client, block: Driven) -> float:
    """Publish the scans of a drive, and return the seconds until all are in the map."""
    started_s = time.monotonic()
    for scan in block.scans:
        client.publish_scan(scan.points, scan.world_from_sensor, no_return=scan.no_return)
        client.flush(_TIMEOUT_S, pending=_AHEAD)
    report = client.flush(_TIMEOUT_S)
    if report.taken < len(block.scans):
        raise RuntimeError(f"scans are missing: {report}")
    return time.monotonic() - started_s


def _points(block: Driven, seed: int) -> Doubles:
    """Return points at random, up to two metres from surfaces that were seen."""
    rng = np.random.default_rng(seed)
    chosen = rng.choice(block.visible, _POINTS)
    return np.asarray(chosen + rng.uniform(-2.0, 2.0, chosen.shape))


def _distances(client: Client, points: Doubles) -> Floats:
    return np.asarray(client.query_distance(points, _REACH_M).distance_m)


def _near_borders(points: Doubles, pitch_m: float) -> Bools:
    """Return which points lie within a search's reach of the border of two regions."""
    off = np.abs(np.abs(points[:, :2] / pitch_m - np.rint(points[:, :2] / pitch_m)) - 0.5)
    return np.asarray(off.min(axis=1) * pitch_m < _NEAR_M)


def _stale(group: _Group, client: Client, block: Driven, points: Doubles) -> float:
    """Return how far distances around the robot are off where one server alone is asked for each.

    That is the 99 % quantile, metres, near borders: a server knows the regions of others as their
    stores have them.
    """
    connection = client._connection
    assert isinstance(connection, SharedConnection)
    apart = np.linalg.norm(points - block.drive.poses[-1, :3, 3], axis=1)
    near = points[_near_borders(points, client.status().region_pitch_m) & (apart < _AROUND_M)]
    pinned = client.pinned()
    owners, epochs = connection.places().owners(near), connection.epochs(pinned.epoch)
    asked = np.asarray(pinned.query_distance(near, _REACH_M).distance_m)
    alone = np.empty(len(near))
    for number in np.unique(owners).tolist():
        mine = owners == number
        with _client(group.servers, share_name(_MAP, number)) as one:
            answer = one.query_distance(near[mine], _REACH_M, at_epoch=epochs[number])
            alone[mine] = answer.distance_m
    return float(np.quantile(np.abs(asked - alone), 0.99))


@dataclass
class _Asked:
    """What a client met that asks all the time."""

    errors: int = 0


@contextmanager
def _asking(client: Client, points: Doubles) -> Iterator[_Asked]:
    """Ask about points at random, all over the map, until the context ends."""
    asked, stopping, rng = _Asked(), threading.Event(), np.random.default_rng(0)

    def ask() -> None:
        while not stopping.wait(_PAUSE_S):
            try:
                client.query_distance(rng.choice(points, _ASKED), _REACH_M)
            except TriquadError:
                asked.errors += 1

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield asked
    finally:
        stopping.set()
        thread.join()


def _until(is_so: Callable[[], bool]) -> float:
    """Wait until something is so, and return the seconds that it took."""
    started_s = time.monotonic()
    while not is_so():
        if time.monotonic() - started_s > _SETTLED_S:
            raise RuntimeError("it does not come about")
        time.sleep(_PAUSE_S)
    return time.monotonic() - started_s


def _numbers(client: Client) -> tuple[list[int], list[int]]:
    """Return the servers that answer for the regions of the map, and for how many each."""
    connection = client._connection
    assert isinstance(connection, SharedConnection)
    owners = [number for holders in connection.shares.leases.values() for number in holders]
    found, counts = np.unique(np.array(owners, np.int64), return_counts=True)
    return found.tolist(), counts.tolist()


def _killed(group: _Group, client: Client, points: Doubles) -> list[Figure]:
    """Kill one of the servers."""
    before, regions = _distances(client, points), client.status().regions
    with _asking(client, points) as asked:
        group.servers[0].process.kill()
        answered_s = _until(lambda: bool(np.isfinite(_distances(client, points)).all()))
        _until(lambda: 1 not in _numbers(client)[0] and sum(_numbers(client)[1]) == regions)
        off = np.abs(_distances(client, points) - before)
    return [
        Figure("one is killed: its places answer after", answered_s, "s", at_most=15),
        Figure("one is killed: errors of the client", asked.errors, "", at_most=0),
        Figure("distances off those of before: 99.9 %", 1e3 * float(np.quantile(off, 0.999)), "mm",
               at_most=1),
    ]  # fmt: skip


def _joined(group: _Group, client: Client, points: Doubles) -> list[Figure]:
    """Start it again."""
    before = _distances(client, points)
    with _asking(client, points) as asked:
        group.start(group.endpoints[0])
        joined_s = _until(lambda: 1 in _numbers(client)[0])
        off = np.abs(_distances(client, points) - before)
    fewest, most = min(_numbers(client)[1]), max(_numbers(client)[1])
    return [
        Figure("one joins: it has regions after", joined_s, "s"),
        Figure("one joins: errors of the client", asked.errors, "", at_most=0),
        Figure("distances off those of before: 99.9 %", 1e3 * float(np.quantile(off, 0.999)), "mm",
               at_most=1),
        Figure("regions of the server with fewest", fewest, ""),
        Figure("regions of the server with most", most, ""),
    ]  # fmt: skip
