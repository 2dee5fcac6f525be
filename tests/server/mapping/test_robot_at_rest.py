"""A robot at rest: what many scans have seen owes no training, what is put before it does."""

import numpy as np
from support.maps.small_world import WALLED, WALLED_BOUNDS, settle
from support.poses import shifted
from triquad_format.records.arrays import Doubles
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box

RNG = np.random.default_rng(0)
HALF = np.array([0.6, 0.9, 0.45])
FRONT = np.column_stack([np.full(60, 4.4), RNG.uniform(-0.3, 1.3, 60), RNG.uniform(0.3, 0.8, 60)])
FEW = {"rays_per_voxel": 6}


def box_at(x: float) -> Solid:
    return box((x, 0.5, 0.45), tuple(HALF))


class Resting:
    """A robot that sees the same place again and again."""

    def __init__(self) -> None:
        training = {"batch": 4096, **FEW}
        self.mapper = Mapper("test", Settings.model_validate({"training": training}), "cpu")
        self.scans = 0

    def scan(self, *there: Solid) -> int:
        """Take in a scan; return how many samples were trained on, of 80,000 for which is time."""
        pose = shifted(0.3, 0.2, 1.4)
        scene = Scene((*WALLED, *there), WALLED_BOUNDS)
        made = Lidar(columns=512).scan(scene, pose, np.random.default_rng(self.scans))
        before, self.scans = self.mapper.samples_trained, self.scans + 1
        self.mapper.ingest(made.points, pose)
        for _ in range(20):
            self.mapper.train()
        self.mapper.publish()
        return self.mapper.samples_trained - before

    def settle(self, *there: Solid) -> None:
        """Rest until scans cause no more training."""
        while sum(self.scan(*there) for _ in range(30)) > 20_000:
            assert self.scans < 400, "it never settles"

    def error_m(self, points: Doubles) -> float:
        """Return the mean distance of the map's surface from points [N, 3] on the true one."""
        settle(self.mapper)
        return float(np.abs(self.mapper.publish().query(points).sdf).mean())


def test_the_map_settles_and_learns_what_is_put_before_the_robot_or_moved() -> None:
    resting = Resting()
    resting.settle()
    assert np.mean([resting.scan() for _ in range(20)]) < 2_000
    assert np.mean([resting.scan(box_at(5.0)) for _ in range(5)]) > 10_000
    assert resting.error_m(FRONT) < 0.03
    resting.settle(box_at(5.0))
    moved_m = 0.08
    for _ in range(60):
        resting.scan(box_at(5.0 + moved_m))
    assert resting.error_m(FRONT + [moved_m, 0, 0]) < 0.03, "it moved by less than a voxel"
