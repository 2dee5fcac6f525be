import numpy as np
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.memory import Memory
from triquad_server.mapping.region_setup import RegionSetup
from triquad_server.mapping.replay.ray_table import VALUE, RayTable, samples_alone
from triquad_server.mapping.replay.region_rays import RegionRays
from triquad_server.process.threads import Teams
from triquad_server.settings import Settings

RNG = np.random.default_rng(0)


def new_rays(capacity: int) -> RegionRays:
    of = Settings()
    setup = RegionSetup(
        of.field,
        of.scan,
        of.change,
        of.training,
        memory=Memory(),
        sums=GradientSums(),
        team=Teams().mapping,
    )
    rays = RegionRays(setup, seed=0)
    rays.limit(capacity)
    return rays


def place(x: float, count: int) -> np.ndarray:
    return (RNG.random((count, 3)) * 4 + [x, 0.0, 0.0]).astype(np.float32)


def labelled(points: np.ndarray, label: float = 0.0) -> RayTable:
    return samples_alone(points, np.full(len(points), label, np.float32))


def test_a_place_left_long_ago_keeps_its_share() -> None:
    pool = new_rays(20_000).pool
    pool.add(labelled(place(-50, 5000), -1))
    for _ in range(100):
        pool.add(labelled(place(50, 5000), 1))
    old = (pool.table.rows[:, VALUE] < 0).sum()
    assert old > 3000, "a hundred scans elsewhere must not push it out"


def test_the_smallest_pools_work() -> None:
    for capacity in (1, 2, 3):
        rays = new_rays(capacity)
        for count in (1, 1, 5):
            rays.pool.add(labelled(place(0, count)))
        assert len(rays.pool) == capacity
        assert len(rays.draw(10, 5).labels) == 10


def test_rays_keep_their_origins_however_many_scans_come_and_go() -> None:
    rays = new_rays(2000)
    for scan in range(300):
        ends = place(0, 100)
        ends[:, 2] = scan  # that of its origin, so that rays are level
        origin = np.array([[-5.0, 0.0, scan]], np.float32)
        rows = np.column_stack([ends, np.ones(100)]).astype(np.float32)
        rays.pool.add(RayTable(rows, np.zeros(100, np.int32), origin))
    table = rays.pool.table
    np.testing.assert_array_equal(table.origins[table.origin_of][:, 2], table.rows[:, 2])
    assert len(table.origins) < 600, "those that no ray has are dropped"
    points = rays.draw(5000, 0).points
    np.testing.assert_allclose(points[:, 2], np.rint(points[:, 2]), atol=1e-3)
