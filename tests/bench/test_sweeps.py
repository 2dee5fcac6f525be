"""A lidar that moves while it turns."""

import numpy as np
from triquad_tools.sensors.motion.placing import place
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import box, half_space

from bench.scenes.sweeps import SWEEP_S, WORLD, SteadyMotion, sweep

ROOM = Scene(
    (half_space(0.0), box((6.0, 0.0, 2.0), (0.5, 9.0, 2.0)), box((0.0, 6.0, 2.0), (9.0, 0.5, 2.0))),
    np.array([[-9.0, -9, -1], [9.0, 9, 5]]),
)
MOTION = SteadyMotion((0.0, 0.0, 1.0), speed_m_s=10.0, yaw_rate_rad_s=1.0)
EXACT = Lidar(beams=8, columns=90, noise_m=0.0)


def distances_m(points: np.ndarray, world_from_sensor: np.ndarray) -> np.ndarray:
    """From the surface, of points in the sensor's frame."""
    world = points @ world_from_sensor[:3, :3].T + world_from_sensor[:3, 3]
    return np.abs(ROOM.sdf(world))


def test_its_points_lie_on_the_surface_where_each_was_measured() -> None:
    measured = sweep(ROOM, EXACT, MOTION, start_s=0.2, rng=np.random.default_rng(0))
    scan = place(measured, MOTION.frames(1.0), WORLD)
    assert distances_m(scan.points, scan.world_from_sensor).max() < 0.002
    assert 2.3 < scan.world_from_sensor[0, 3] < 2.7  # about the middle of the sweep
    as_it_is = MOTION.pose(0.2 + SWEEP_S / 2).matrix()
    assert distances_m(measured.points, as_it_is).max() > 0.3  # of walls; the floor is flat
