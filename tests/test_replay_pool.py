import numpy as np
import torch
from triquad_server.replay_pool import ReplayPool

CPU = torch.device("cpu")


def place(x: float, count: int) -> torch.Tensor:
    return torch.rand((count, 3)) * 4 + torch.tensor([x, 0.0, 0.0])


def test_it_is_bounded() -> None:
    pool = ReplayPool(1000, CPU, 0)
    for i in range(30):
        pool.add(place(i, 300), torch.zeros(300))
        assert len(pool) == min(1000, 300 * (i + 1))
    pool.add(place(0, 5000), torch.zeros(5000))
    assert len(pool) == 1000


def test_samples_come_back_as_they_were() -> None:
    pool = ReplayPool(10_000, CPU, 0)
    points = place(0, 8000)
    pool.add(points, points[:, 0] * 3)
    batch = pool.draw(500, 0)
    torch.testing.assert_close(batch.labels, batch.points[:, 0] * 3)
    assert len(torch.unique(batch.points[:, 0])) > 400


def test_a_place_left_long_ago_keeps_its_share() -> None:
    pool = ReplayPool(20_000, CPU, 0)
    pool.add(place(-50, 5000), torch.full((5000,), -1.0))
    for _ in range(100):
        pool.add(place(50, 5000), torch.ones(5000))
    old = (pool.sample(20_000).labels < 0).sum()
    assert old > 3000, "a hundred scans elsewhere must not push it out"


def test_the_newest_can_be_drawn_apart() -> None:
    pool = ReplayPool(100_000, CPU, 0)
    pool.add(place(0, 50_000), torch.zeros(50_000))
    pool.add(place(0, 100), torch.ones(100))
    batch = pool.draw(1000, 400)
    assert batch.labels[:400].min() == 1
    assert batch.labels[400:].mean() < 0.05


def test_forgetting_a_box() -> None:
    pool = ReplayPool(10_000, CPU, 0)
    points = place(0, 6000)
    pool.add(points, torch.zeros(6000))
    low, high = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([2.0, 4.0, 4.0])
    pool.forget(low, high)
    inside = ((points >= low) & (points <= high)).all(dim=1).sum()
    assert len(pool) == 6000 - inside
    left = pool.sample(10_000).points
    assert not ((left >= low) & (left <= high)).all(dim=1).any()
    pool.add(place(1, 3000), torch.zeros(3000))
    assert len(pool) == 9000 - inside


def test_the_smallest_pools_work() -> None:
    for capacity in (1, 2, 3):
        pool = ReplayPool(capacity, CPU, 0)
        for count in (1, 1, 5):
            pool.add(place(0, count), torch.zeros(count))
        assert len(pool) == capacity
        assert len(pool.draw(10, 5).labels) == 10


def test_a_lower_limit_takes_effect_at_once() -> None:
    pool = ReplayPool(10_000, CPU, 0)
    pool.add(place(0, 9000), torch.zeros(9000))
    pool.limit(2000)
    assert len(pool) == 2000
    pool.add(place(0, 9000), torch.zeros(9000))
    assert len(pool) == 2000
    assert np.isfinite(pool.draw(100, 50).points.numpy()).all()
