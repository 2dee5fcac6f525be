"""How much memory arrays take, however they are shared and nested."""

import numpy as np
import torch
from support.maps.small_world import settings, world
from triquad_server.epochs.array_memory import buffers_of, bytes_by_part
from triquad_server.mapping.mapper import Mapper


def total(part: object) -> int:
    return sum(buffers_of(part).values())


def test_a_piece_of_memory_counts_once_and_whole() -> None:
    array = np.zeros(1000, np.float64)
    tensor = torch.from_numpy(array)
    assert total(array) == 8000
    assert total([array, array[10:20], array.reshape(10, 100), {"a": (tensor, tensor[:5])}]) == 8000
    assert total((array, np.zeros(10, np.uint8))) == 8010
    assert total(torch.zeros(100)[:3]) == 400


def test_what_is_shared_belongs_to_the_first_part() -> None:
    one, other = np.zeros(100, np.uint8), np.zeros(10, np.uint8)
    assert bytes_by_part({"a": one, "b": (one, other), "c": other}) == {"a": 100, "b": 10, "c": 0}
    assert bytes_by_part({"b": (one, other)}, without=buffers_of(one)) == {"b": 10}


def test_a_map_takes_what_its_arrays_take() -> None:
    mapper = Mapper("test", settings(), "cpu")
    scan = world(1).scans[0]
    mapper.ingest(scan.points, scan.world_from_sensor)
    mapper.train()
    for live, region in zip(mapper.regions, mapper.publish().frozen_regions, strict=True):
        rows = live.field.features
        # The features themselves are the epoch's, until training goes on.
        assert region.live_bytes["field"] >= sum(
            part.nbytes for part in (rows.means, rows.variances, rows.steps)
        )
        assert total(region.engine) >= rows.values.nbytes
        assert not buffers_of(rows.values, without=region.buffers)
        assert region.live_bytes["replay_pools"] > 0
        assert total(region.evidence) >= 2 * region.evidence.seen.surface.nbytes
        # The live quadtree and the published one share what never changes.
        assert total((region.engine, live.field)) < total(region.engine) + total(live.field)
