"""A robot at rest: after how much training its map settles while scans arrive.

It drives into a street, stands there, and a box is put down before it. Training is counted in
samples; between two scans there is time for as many steps as in all benchmarks that stream.
"""

from collections.abc import Iterable

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_server.settings import Settings
from triquad_tools.console.progress import progress
from triquad_tools.sensors.sweep import PosedScan
from triquad_tools.simulation.lidar import Lidar, SimulatedDrive, drive
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box
from triquad_tools.simulation.street import street

from bench.figures import Figure
from bench.street import StreamedMap, learn_all, sdf_error_cm
from bench.street_scores import driven_street

_LENGTH_M, _DRIVEN, _STEP_M = 110.0, 40, 1.0
_COLUMNS = 1024
_MOST = 1_500  # scans at rest: longer than that is for ever
_QUIET, _FEW_SAMPLES = 20, 1_000  # scans, after each of which so little was left to learn
_WITH_BOX = 30
_AHEAD_M, _HALF_M = 5.0, np.array([0.6, 0.9, 0.45])  # where the box is put, and its half sides


def measure_parked(seed: int) -> list[Figure]:
    """Return what a robot at rest trains, and how good its map is before, during and after."""
    scene = street(seed, _LENGTH_M)
    way = drive(scene, _DRIVEN, _STEP_M)
    driven = driven_street(SimulatedDrive(scene, Lidar(columns=_COLUMNS), way, seed=seed))
    robot = StreamedMap(Settings())
    for taken in driven.scans:
        robot.take_in(taken)
    arrived = sdf_error_cm(robot.mapper.publish(), driven.probes)
    trained = _rest(robot, _at_rest(scene, way[-1], _MOST, seed + 1))
    error = sdf_error_cm(robot.mapper.publish(), driven.probes)
    quiet = [_trained(robot, scan) for scan in _at_rest(scene, way[-1], 3 * _QUIET, seed + 2)]
    ahead = way[-1][:3, :3] @ [_AHEAD_M, 0, 0] + way[-1][:3, 3]
    centre = (float(ahead[0]), float(ahead[1]), float(_HALF_M[2]))
    with_box = Scene((*scene.solids, box(centre, tuple(_HALF_M.tolist()))), scene.bounds)
    for scan in _at_rest(with_box, way[-1], _WITH_BOX, seed + 3):
        robot.take_in(scan)
    learn_all(robot.mapper)
    front = _front(np.array(centre), way[-1][:3, 3])
    off = robot.mapper.publish().query(front, gradient=False).sdf
    return [
        Figure("SDF error of the street, as the robot arrives", arrived, "cm"),
        Figure("scans at rest until nothing is left to learn", len(trained), "", at_most=_MOST - 1),
        Figure("training samples until then", sum(trained) / 1e6, "M"),
        Figure("SDF error of the street then", error, "cm", at_most=arrived),
        Figure("samples between two scans from then on", float(np.mean(quiet)), ""),
        Figure("SDF error at a box put down then", 100 * float(np.abs(off).mean()), "cm"),
    ]


def _rest(robot: StreamedMap, scans: Iterable[PosedScan]) -> list[int]:
    """Return the samples that are trained on after each scan, until these are few."""
    trained: list[int] = []
    with progress("at rest", _MOST) as report:
        for number, scan in enumerate(scans):
            trained.append(_trained(robot, scan))
            report(number, f"{robot.mapper.samples_left / 1e6:.1f} million samples left")
            if len(trained) >= _QUIET and sum(trained[-_QUIET:]) < _QUIET * _FEW_SAMPLES:
                break
    return trained


def _trained(robot: StreamedMap, scan: PosedScan) -> int:
    """Integrate a scan; return on how many samples the map was trained after it."""
    before = robot.mapper.samples_trained
    robot.take_in(scan)
    return robot.mapper.samples_trained - before


def _at_rest(scene: Scene, pose: Doubles, count: int, seed: int) -> Iterable[PosedScan]:
    return SimulatedDrive(scene, Lidar(columns=_COLUMNS), np.array([pose] * count), seed=seed)


def _front(centre: Doubles, seen_from: Doubles) -> Doubles:
    """Return points [N, 3] on that face of the box which looks along the street to the robot."""
    side = np.sign(seen_from[0] - centre[0])
    y, z = np.meshgrid(np.linspace(-0.8, 0.8, 17), np.linspace(-0.2, 0.4, 7))
    x = np.full(y.size, side * _HALF_M[0])
    points: Doubles = centre + np.column_stack([x, y.ravel(), z.ravel()])
    return points
