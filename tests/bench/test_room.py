from collections.abc import Callable

import numpy as np
import pytest
from triquad_tools.simulation.lidar import SimulatedDrive

from bench.scenes.room import room, room_by_camera, room_by_lidar
from bench.scenes.tabletop import tabletop_by_camera

MAKERS = {"camera": room_by_camera, "lidar": room_by_lidar, "tabletop": tabletop_by_camera}

Make = Callable[[int, int], SimulatedDrive]


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
@pytest.mark.parametrize("seed", range(6))
def test_the_sensor_stays_in_free_space(make: Make, seed: int) -> None:
    drive = make(seed, 100)
    assert drive.scene.sdf(drive.poses[:, :3, 3]).min() > 0.15
    rotations = drive.poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (100, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_room_is_closed_and_has_furniture(seed: int) -> None:
    drive = room_by_lidar(seed, 50)
    scan = drive.scan(20)
    assert len(scan.no_return) == 0
    low, high = room(seed).bounds
    assert ((scan.true_hits >= low) & (scan.true_hits <= high)).all()
    inside = ((scan.true_hits > low + 0.12) & (scan.true_hits < high - 0.12)).all(axis=1)
    assert 0.1 < inside.mean() < 0.9  # neither walls alone, nor a cupboard before the sensor
