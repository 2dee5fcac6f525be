import numpy as np
import torch
from support.maps.small_world import settings, world
from triquad_server.epochs.epoch import buffers_of
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


def test_a_map_takes_what_its_arrays_take() -> None:
    mapper = Mapper("test", settings(), "cpu")
    scan = world(1).scans[0]
    mapper.ingest(scan.points, scan.world_from_sensor)
    mapper.train()
    for live, region in zip(mapper.regions, mapper.publish().frozen_regions, strict=True):
        rows = live.field.features
        assert total(region.engine) >= rows.values.nbytes
        # The features themselves are the epoch's, until training goes on.
        assert buffers_of(rows.values).keys() <= region.buffers.keys()
        assert total(region.evidence) >= 2 * region.evidence.seen.surface.nbytes
        # The live quadtree and the published one share what never changes.
        assert total((region.engine, live.field)) < total(region.engine) + total(live.field)
