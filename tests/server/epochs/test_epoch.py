import numpy as np
import pytest
from support.maps.small_world import settings, settled_mapper, world
from triquad_map.composition.recorded_view import RecordedView
from triquad_server.epochs.epoch import Epoch

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def epoch() -> Epoch:
    return settled_mapper(settings(samples_per_ray=3.0), world(3)).publish()


def test_the_numpy_evaluator_gives_the_same_answers(epoch: Epoch) -> None:
    hits = world(3).hits
    near = hits[RNG.choice(len(hits), 5000)] + RNG.normal(0, 0.1, (5000, 3))
    anywhere = RNG.uniform(hits.min(axis=0) - 30, hits.max(axis=0) + 30, (5000, 3))
    points = np.concatenate([near, anywhere])
    live = epoch.query(points, gradient=True)
    offline = RecordedView(epoch.record()).query(points, gradient=True)
    np.testing.assert_array_equal(offline.status, live.status)
    np.testing.assert_allclose(offline.sdf, live.sdf, atol=1e-5)
    known = np.isfinite(live.sdf)
    error = np.abs(offline.gradient - live.gradient)[known].max(axis=1)
    assert np.quantile(error, 0.99) < 1e-3, "all but points on a kink"
    np.testing.assert_array_equal(np.isnan(offline.sdf), np.isnan(live.sdf))
