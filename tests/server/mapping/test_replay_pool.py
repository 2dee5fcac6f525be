import numpy as np
from triquad_format.records.field_settings import FieldSettings
from triquad_server.engine.live_field import Batch
from triquad_server.mapping.replay.ray_table import Placement, RayTable, samples_alone
from triquad_server.mapping.replay.replay_pool import ReplayPool
from triquad_server.process.threads import Teams

PLACEMENT = Placement(
    surface_share=0.5,
    spread_m=0.08,
    behind_m=0.8,
    half_side_m=400.0,
)
TEAM = Teams().mapping
RNG = np.random.default_rng(0)


def new_pool(capacity: int) -> ReplayPool:
    pool = ReplayPool(PLACEMENT, settings=FieldSettings(), seed=0, team=TEAM)
    pool.limit(capacity)
    return pool


def place(x: float, count: int) -> np.ndarray:
    return (RNG.random((count, 3)) * 4 + [x, 0.0, 0.0]).astype(np.float32)


def labelled(points: np.ndarray, label: float = 0.0) -> RayTable:
    return samples_alone(points, np.full(len(points), label, np.float32))


def whole(pool: ReplayPool) -> Batch:
    return pool.draw_on(np.arange(len(pool)))


def test_a_place_left_long_ago_keeps_its_share() -> None:
    pool = new_pool(20_000)
    pool.add(labelled(place(-50, 5000), -1))
    for _ in range(100):
        pool.add(labelled(place(50, 5000), 1))
    old = (whole(pool).labels < 0).sum()
    assert old > 3000, "a hundred scans elsewhere must not push it out"


def test_the_smallest_pools_work() -> None:
    for capacity in (1, 2, 3):
        pool = new_pool(capacity)
        for count in (1, 1, 5):
            pool.add(labelled(place(0, count)))
        assert len(pool) == capacity
        assert len(pool.draw(10, 5).labels) == 10


def test_rays_keep_their_origins_however_many_scans_come_and_go() -> None:
    pool = new_pool(2000)
    for scan in range(300):
        ends = place(0, 100)
        ends[:, 2] = scan  # that of its origin, so that rays are level
        origin = np.array([[-5.0, 0.0, scan]], np.float32)
        rows = np.column_stack([ends, np.ones(100)]).astype(np.float32)
        pool.add(RayTable(rows, np.zeros(100, np.int32), origin))
    table = pool.table
    np.testing.assert_array_equal(table.origins[table.origin_of][:, 2], table.rows[:, 2])
    assert len(table.origins) < 600, "those that no ray has are dropped"
    points = pool.draw(5000, 0).points
    np.testing.assert_allclose(points[:, 2], np.rint(points[:, 2]), atol=1e-3)
