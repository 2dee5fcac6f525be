"""Poses that are corrected: the map after that, how soon it is there, and what a planner meets.

A car drives along a street and back in the other lane, and the way back is off by 0.3 m and 1
degree. Another one drives around a block, and all of its way drifts by 0.5 % and 0.3 degrees each
10 m. On a way of 500 m up and down a street, 50 scans amid it are off, and the last tenth.
"""

import argparse
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Event, Thread

import numpy as np
from scipy.spatial.transform import Rotation
from triquad_client import Client, CorrectPosesReply, Mesh
from triquad_format.records.arrays import Doubles
from triquad_tools.demo.probe import ProbeReport
from triquad_tools.evaluation.metrics import MeshScores
from triquad_tools.recordings.publishing import FLUSH_TIMEOUT_S, publish_all, wait_until_settled
from triquad_tools.recordings.recording import DEFAULT_SOURCE, ScanEntry
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.street import street_drive

from bench.clients.served import Served, latency_figures, near_surface, served
from bench.figures import Figure
from bench.scenes.block import block_drive
from bench.street_scores import DrivenStreet, driven_street

_SENSOR = Lidar(columns=1024)
_LENGTH_M, _SCANS = 60.0, 130  # a metre apart: there, around and back
_BACK = 65  # the first scan of the way back
_SIDE_M, _AROUND_SCANS = 60.0, 254  # of a block, and around it to the first 10 m again
_LONG_M, _LONG_SCANS = 245.0, 500  # of the long way
_AMID, _AFTER, _LAST = 225, 275, 450
"""The first scan that is off amid the long way, the first after these, and the first of the last
tenth."""
_RAISED_M = 0.2  # how far up all scans of the long way are moved at last
_OFF_M, _OFF_DEG = 0.3, 1.0
_DRIFT_SHARE, _DRIFT_DEG_PER_M = 0.005, 0.03
_FIRST_S = 1_700_000_000  # when the drive begins; a scan each second
_SETTLE_LIMIT_S = 1200.0
_WATCH_S = 0.05  # between two looks at the epoch of a map that is being corrected
_ASSIGNED = ("store.log_max_bytes=2000000000", "store.period_s=6", "store.keep=100")
_SETTINGS = [word for one in _ASSIGNED for word in ("--set", one)]


@dataclass(frozen=True)
class _Corrected:
    """A map that wrong poses have made, and that was corrected."""

    wrong: MeshScores
    right: MeshScores
    taken_s: float  # until the first epoch of the corrected map
    settled_s: float  # and until that had settled
    met: ProbeReport  # by a planner meanwhile


def measure(options: argparse.Namespace) -> list[Figure]:
    """Return figures of corrected poses."""
    back = driven_street(street_drive(options.seed, _SCANS, 1.0, _LENGTH_M, _SENSOR))
    around = block_drive(options.seed, _SIDE_M, _AROUND_SCANS, 1.0, _SENSOR)
    true, loop = back.drive.poses, driven_street(around)
    with _driven(back.scans, true) as server:
        never = back.mesh_scores(_settled_mesh(server.client))
        log_bytes = sum(path.stat().st_size for path in server.folder.rglob("scans-*.mcap"))
    with _driven(loop.scans, around.poses) as server:
        never_around = loop.mesh_scores(_settled_mesh(server.client))
    off = _corrected(back, _off(true, _BACK), _BACK)
    drift = _corrected(loop, drifting(around.poses), 0)
    points = sum(len(scan.points) for scan in back.scans)
    return [
        *_map_figures("way back off by 0.3 m and 1 degree", off, never),
        *_map_figures("block, drift of 0.5 % and 0.3 degrees each 10 m", drift, never_around),
        Figure("block: corrected map there", drift.taken_s, "s"),
        Figure("block: and settled, after", drift.settled_s, "s"),
        *latency_figures("1,000 points with gradient meanwhile", drift.met),
        *_long_figures(options.seed),
        Figure("scan log, per point", log_bytes / points, "bytes"),
        Figure("scan log, per km", log_bytes / 1e6 / (_SCANS / 1000), "MB"),
    ]


def _map_figures(name: str, corrected: _Corrected, never: MeshScores) -> list[Figure]:
    """Return how good the map was before and after, against one that never was wrong."""
    lost = 100 * (never.f_score - corrected.right.f_score)
    doubled = 100 * (never.accuracy_ratio - corrected.right.accuracy_ratio)
    return [
        Figure(f"{name}: F of a map that never was wrong", 100 * never.f_score, "%"),
        Figure(f"{name}: F before", 100 * corrected.wrong.f_score, "%"),
        Figure(f"{name}: F less than never wrong", lost, "points", at_most=0.3),
        Figure(f"{name}: more surface that is none", doubled, "points", at_most=1),
    ]


def _off(true: Doubles, first: int) -> Doubles:
    """Return poses [N, 4, 4] that are off from a scan on, turned about the place of that one."""
    turn, place = np.eye(4), true[first, :3, 3]
    turn[:3, :3] = Rotation.from_euler("z", _OFF_DEG, degrees=True).as_matrix()
    turn[:3, 3] = place - turn[:3, :3] @ place + _OFF_M * np.array([0.6, 0.8, 0.0])
    return np.concatenate([true[:first], turn @ true[first:]])


def drifting(true: Doubles) -> Doubles:
    """Return poses [N, 4, 4] of an odometry that goes too far and turns too much."""
    steps = np.linalg.inv(true[:-1]) @ true[1:]
    lengths_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    steps[:, :3, 3] *= 1 + _DRIFT_SHARE
    turned_deg = _DRIFT_DEG_PER_M * lengths_m[:, None]
    steps[:, :3, :3] @= Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    poses = [true[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def _corrected(made: DrivenStreet, wrong: Doubles, first: int) -> _Corrected:
    """Map with wrong poses, and correct them from scan ``first`` on."""
    true = made.drive.poses
    with _driven(made.scans, wrong) as server:
        before = made.mesh_scores(_settled_mesh(server.client))
        stamps_s = _stamps_s(first, len(true))
        started_s = time.monotonic()
        with server.planner(near_surface(made), "gradient") as probe:
            server.client.correct_poses(DEFAULT_SOURCE, stamps_s, true[first:])
            taken_s = time.monotonic() - started_s
            met = probe.finish()
        mesh = _settled_mesh(server.client)
        settled_s = time.monotonic() - started_s
        after = made.mesh_scores(mesh)
    return _Corrected(before, after, taken_s, settled_s, met)


def _settled_mesh(client: Client) -> Mesh:
    wait_until_settled(client, _SETTLE_LIMIT_S)
    return client.mesh()


@dataclass(frozen=True)
class _Timed:
    """How long a correction took."""

    there_s: float  # until the first epoch of the corrected map
    settled_s: float  # until nothing was left to learn
    reply: CorrectPosesReply


def _long_figures(seed: int) -> list[Figure]:
    """Correct the last scans of a long way, some amid it, and all, each once it has settled."""
    drive = street_drive(seed, _LONG_SCANS, 1.0, _LONG_M, _SENSOR)
    true, wrong = drive.poses, drive.poses.copy()
    wrong[_AMID:_AFTER] = _off(true, _AMID)[_AMID:_AFTER]
    wrong[_LAST:] = _off(true, _LAST)[_LAST:]
    raised = true.copy()
    raised[:, 2, 3] += _RAISED_M
    scans = list(drive)
    with _driven(scans[:_LAST], wrong[:_LAST]) as server:
        wait_until_settled(server.client, _SETTLE_LIMIT_S)
        began_s = time.monotonic()
        _drive(server.client, scans[_LAST:], wrong[_LAST:], _LAST)
        wait_until_settled(server.client, _SETTLE_LIMIT_S)
        taken_s = time.monotonic() - began_s
        last = _timed(server, _LAST, _LONG_SCANS, true)
        amid = _timed(server, _AMID, _AFTER, true)
        whole = _timed(server, 0, _LONG_SCANS, raised)
    figures = [
        Figure("500 m: its last 50 scans taken in and settled", taken_s, "s"),
        Figure("500 m: all raised by 0.2 m: corrected map there", whole.there_s, "s"),
        Figure("500 m: and settled, after", whole.settled_s, "s"),
        Figure("last tenth: of what all take", last.there_s / whole.there_s, "", at_most=0.2),
    ]
    for name, one in (("last tenth of 500 m", last), ("50 scans amid 500 m", amid)):
        settled = one.settled_s / taken_s
        figures += [
            Figure(f"{name}: corrected map there", one.there_s, "s", at_most=1),
            Figure(f"{name}: scans made again", one.reply.scans_learnt, ""),
            Figure(f"{name}: settled, of what 50 scans took", settled, "", at_most=1.5),
        ]
    return figures


def _timed(server: Served, first: int, end: int, poses: Doubles) -> _Timed:
    """Correct some scans, and see when the first epoch with them is there."""
    seen, done = list[tuple[float, int]](), Event()
    began_s = time.monotonic()

    def watch() -> None:
        with server.another_client() as client:
            while not done.wait(_WATCH_S):
                epoch = client.status().epoch
                seen.append((time.monotonic() - began_s, epoch))

    watching = Thread(target=watch)
    watching.start()
    try:
        reply = server.client.correct_poses(DEFAULT_SOURCE, _stamps_s(first, end), poses[first:end])
    finally:
        done.set()
        watching.join()
    replied_s = time.monotonic() - began_s
    there_s = min((s for s, epoch in seen if epoch >= reply.epoch), default=replied_s)
    wait_until_settled(server.client, _SETTLE_LIMIT_S)
    return _Timed(there_s, time.monotonic() - began_s, reply)


def _stamps_s(first: int, end: int) -> list[int]:
    return [_FIRST_S + number for number in range(first, end)]


@contextmanager
def _driven(scans: Iterable[PosedScan], poses: Doubles) -> Iterator[Served]:
    """Yield a server that keeps scans and was given all of them, with these poses."""

    with served(arguments=_SETTINGS) as server:
        _drive(server.client, scans, poses)
        yield server


def _drive(client: Client, scans: Iterable[PosedScan], poses: Doubles, first: int = 0) -> None:
    """Publish scans with these poses; ``first`` is the number of the first."""

    def published() -> Iterator[tuple[ScanEntry, PosedScan]]:
        for number, (scan, pose) in enumerate(zip(scans, poses, strict=True), first):
            entry = ScanEntry((_FIRST_S + number) * 1_000_000_000, DEFAULT_SOURCE)
            yield entry, PosedScan(scan.points, pose)

    publish_all(client, published(), len(poses))
    client.flush(FLUSH_TIMEOUT_S)
