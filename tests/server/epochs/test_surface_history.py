"""Where surface appeared and vanished, held against the maps themselves."""

import numpy as np
import pytest
from support.poses import shifted
from support.servers import sphere
from triquad_format.errors import RefusedError
from triquad_format.records.region import surface_voxels
from triquad_server.epochs.surface_history import SurfaceHistory
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings

SETTINGS = Settings.model_validate(
    {"field": {"depth": 6}, "training": {"batch": 64, "samples_per_ray": 1.0, "pool_bytes": 24_000}}
)
LEAF_M = SETTINGS.field.leaf_m
PITCH_M = SETTINGS.field.region_pitch_m
EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)
MANY = 1_000_000


def voxels_of(epoch):
    middles = surface_voxels(epoch.record())
    voxels = np.floor(middles / LEAF_M).astype(int).tolist()
    assert len(voxels) == len({tuple(voxel) for voxel in voxels})
    return {tuple(voxel) for voxel in voxels}


def see(mapper, x=0.0, radius_m=2.0, count=60):
    mapper.ingest(sphere(count, radius_m), shifted(x, 0.3, -0.7))


def told(history, since, until):
    """The voxels that appeared and vanished, and the epoch of each."""
    changes = history.between(since, until)
    rows = list(zip(map(tuple, changes.voxels.tolist()), changes.epochs.tolist(), strict=True))
    new = changes.appeared
    return (
        {voxel: epoch for (voxel, epoch), is_new in zip(rows, new, strict=True) if is_new},
        {voxel: epoch for (voxel, epoch), is_new in zip(rows, new, strict=True) if not is_new},
    )


def shifting_map():
    """Epochs of a map of several regions that is seen, forgotten and seen again."""
    rng = np.random.default_rng(3)
    mapper = Mapper("test", SETTINGS, "cpu")
    yield mapper.publish()
    for step in range(14):
        see(mapper, x=rng.uniform(0, 2 * PITCH_M))
        if step % 4 == 2:
            low = rng.uniform([0, -3, -3], [2 * PITCH_M, 0, 0])
            mapper.reset(low, low + 4.0)
        if step == 9:
            mapper.reset(*EVERYWHERE)
        yield mapper.publish()


def test_between_any_two_epochs_it_tells_how_they_differ():
    epochs = list(shifting_map())
    history = SurfaceHistory(epochs[0], MANY)
    for epoch in epochs[1:]:
        history.add(epoch)
    known = {epoch.number: voxels_of(epoch) for epoch in epochs}
    assert max(map(len, known.values())) > 100
    vanishing = 0
    for since in known:
        for until in range(since, epochs[-1].number + 1):
            appeared, vanished = told(history, since, until)
            assert appeared.keys() == known[until] - known[since]
            assert vanished.keys() == known[since] - known[until]
            vanishing += len(vanished)
            for voxel, epoch in [*appeared.items(), *vanished.items()]:
                assert since < epoch <= until
                assert (voxel in known[epoch]) != (voxel in known[epoch - 1])
                assert all(
                    (voxel in known[later]) == (voxel in known[until])
                    for later in range(epoch, until)
                )
    assert vanishing > 100


def test_a_region_that_is_forgotten_and_seen_again_between_two_epochs_is_compared_too():
    mapper = Mapper("test", SETTINGS, "cpu")
    see(mapper)
    first = mapper.publish()
    mapper.reset(*EVERYWHERE)
    see(mapper, x=0.5)
    second = mapper.publish()
    history = SurfaceHistory(first, MANY)
    history.add(second)
    appeared, vanished = told(history, first.number, second.number)
    assert appeared.keys() == voxels_of(second) - voxels_of(first)
    assert vanished.keys() == voxels_of(first) - voxels_of(second)


def test_training_alone_changes_nothing():
    mapper = Mapper("test", SETTINGS, "cpu")
    see(mapper)
    first = mapper.publish()
    history = SurfaceHistory(first, 0)  # nothing that changed could be kept
    mapper.train()
    second = mapper.publish()
    assert second.number > first.number
    history.add(second)
    assert not len(history.between(first.number, second.number).voxels)


def test_what_there_is_no_room_for_is_refused_with_the_oldest_epoch_to_ask_from():
    epochs = list(shifting_map())[:5]
    sizes = [
        len(voxels_of(one) ^ voxels_of(other))
        for one, other in zip(epochs[:-1], epochs[1:], strict=True)
    ]
    assert all(sizes)
    history = SurfaceHistory(epochs[0], sizes[-1] + sizes[-2])
    for epoch in epochs[1:]:
        history.add(epoch)
    oldest, newest = epochs[2].number, epochs[-1].number
    for since in (epochs[0].number, oldest - 1, newest + 1):
        with pytest.raises(RefusedError, match=f"oldest to ask from is {oldest}") as caught:
            history.between(since, newest)
        assert caught.value.code == "epoch_gone"
        assert f"newest epoch is {newest}" in str(caught.value)
    appeared, vanished = told(history, oldest, newest)
    assert appeared.keys() | vanished.keys() == voxels_of(epochs[2]) ^ voxels_of(epochs[-1])
