import numpy as np
import pytest
import torch
from support.maps.small_world import mapper_of, settings, settled_mapper, world
from triquad_map.composition.composed_view import RecordedView
from triquad_server.epochs.buffers import buffers_of
from triquad_server.epochs.epoch import Epoch

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def epoch() -> Epoch:
    return settled_mapper(settings(samples_per_ray=3.0), world(3)).publish()


def test_a_record_answers_as_the_epoch_that_it_is_of(epoch: Epoch) -> None:
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


def total(part: object) -> int:
    return sum(buffers_of(part).values())


def test_a_piece_of_memory_counts_once_and_whole() -> None:
    array = np.zeros(1000, np.float64)
    tensor = torch.from_numpy(array)
    assert total(array) == 8000
    assert total([array, array[10:20], array.reshape(10, 100), {"a": (tensor, tensor[:5])}]) == 8000
    assert total((array, np.zeros(10, np.uint8))) == 8010
    assert total(torch.zeros(100)[:3]) == 400


def test_a_map_takes_what_its_arrays_take() -> None:
    mapper = mapper_of(*world(1).scans)
    mapper.train()
    for live, region in zip(mapper.regions, mapper.publish().frozen_regions, strict=True):
        rows = live.field.features
        assert total(region.engine) >= rows.values.nbytes
        # The features themselves are the epoch's, until training goes on.
        assert buffers_of(rows.values).keys() <= region.buffers.keys()
        assert total(region.evidence) >= 2 * region.evidence.seen.surface.nbytes
        # The live quadtree and the published one share what never changes.
        assert total((region.engine, live.field)) < total(region.engine) + total(live.field)
