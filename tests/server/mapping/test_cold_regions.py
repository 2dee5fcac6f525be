"""Regions that leave memory, answer from the store, and come back."""

import threading
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import servers
from support.maps.map_records import assert_same
from support.maps.small_world import settings, settle
from support.poses import shifted
from triquad_format.errors import RefusedError
from triquad_format.records.region import MapRecord
from triquad_format.records.status import Status
from triquad_map.compiled.team import in_one
from triquad_server.epochs.cold_region import ColdRegion, RegionCache
from triquad_server.epochs.epoch import Epoch
from triquad_server.epochs.surface_history import CHANGES_KEPT, SurfaceHistory
from triquad_server.errors import NoRoomYetError, ScanRefusedError
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import MemorySettings, StoreSettings
from triquad_server.store.store import Store

APART_M = 60.0  # places, of which each is in a region of its own
CACHE_BYTES = 100_000_000
LITTLE_BYTES = 12_000_000  # room for two places
NOWHERE = np.full(3, -np.inf), np.full(3, np.inf)


class KeptMap:
    """A map with a store, without threads and clocks."""

    def __init__(self, folder: Path, max_bytes: int = 10**9) -> None:
        memory = MemorySettings(max_bytes=max_bytes)
        chosen = settings().model_copy(update={"memory": memory})
        self.store = Store(folder, "test", StoreSettings(), lambda: CACHE_BYTES)
        newest = self.store.newest()
        record = None if newest is None else newest.record
        self.mapper = Mapper("test", chosen, "cpu", record, cold=self.store.regions.known)
        self.mapper.regions.room.stored(self.store.regions.known)

    def visit(self, *places: int) -> None:
        """Take in a scan at each place."""
        for place in places:
            self.mapper.ingest(
                servers.sphere(8000), shifted(APART_M * place), stamp_s=1_700_000_000
            )

    def checkpoint(self) -> None:
        """Write what changed, and tell the map."""
        taken = self.mapper.snapshot_since(self.store.base_epoch)
        self.store.write(taken.epoch.record(()), taken.records(), taken.facts)
        self.mapper.regions.room.stored(self.store.regions.known)

    def leave(self, *but: int) -> Epoch:
        """Have all regions leave memory but those around some places."""
        pitch_m = self.mapper.regions.field.region_pitch_m
        near = {round(APART_M * place / pitch_m) for place in but}
        for region in list(self.mapper.regions):
            if region.index[0] not in near:
                self.mapper.regions.all.leave(self.store.regions.known[region.index])
        return self.mapper.publish()


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[KeptMap]:
    kept = KeptMap(tmp_path)
    with closing(kept.store):
        yield kept


def around(place: int, count: int = 2000) -> NDArray[np.float64]:
    """Points [count, 3] around a place, some of them near its surface."""
    rng = np.random.default_rng(place)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = rng.uniform(0.5, 4.5, (count, 1)) * directions
    return points + np.array([APART_M * place, 0.0, 0.0])


def assert_answers_alike(one: Epoch, other: Epoch, points: NDArray[np.float64]) -> None:
    """Two epochs tell the same, but for features that are rounded in a file."""
    before, after = (epoch.query(points, gradient=True) for epoch in (one, other))
    np.testing.assert_array_equal(before.status, after.status)
    np.testing.assert_allclose(before.sdf, after.sdf, rtol=0, atol=2e-3)
    near = [epoch.nearest_surface(points, 3.0) for epoch in (one, other)]
    np.testing.assert_array_equal(near[0].found, near[1].found)
    off = np.abs(near[0].distance - near[1].distance)
    assert np.quantile(off, 0.99) < 2e-3
    spaces = [epoch.nearest_unknown(points, 1.0).distance for epoch in (one, other)]
    np.testing.assert_array_equal(*spaces)


def test_what_left_memory_answers_as_before(kept: KeptMap) -> None:
    kept.visit(0, 1, 2)
    settle(kept.mapper)
    before = kept.mapper.publish()
    kept.checkpoint()
    used = kept.mapper.regions.bytes_used
    after = kept.leave(2)
    assert after.number > before.number
    assert (after.regions, after.vertices) == (before.regions, before.vertices)
    assert after.cold_regions == len(kept.mapper.regions) - len(list(kept.mapper.regions)) > 0
    assert kept.mapper.regions.bytes_used < 0.5 * used
    everywhere = np.concatenate([around(place) for place in (0, 1, 2)])
    assert_answers_alike(before, after, everywhere)
    assert (after.status(around(0)) == Status.SURFACE).any()


def test_a_scan_brings_a_region_back_with_all_that_it_learns_on(kept: KeptMap) -> None:
    kept.visit(0, 1)
    kept.checkpoint()
    rays, left = kept.mapper.regions.all.rays_kept, kept.mapper.samples_left
    before = kept.mapper.publish()
    kept.leave(1)
    assert (kept.mapper.regions.all.rays_kept, kept.mapper.samples_left) == (rays, left), (
        "they still count"
    )
    kept.visit(0)
    assert kept.mapper.publish().cold_regions == 0
    assert kept.mapper.regions.all.rays_kept > 0.9 * rays
    settle(kept.mapper)
    found = kept.mapper.publish().query(around(0))
    known = before.status(around(0))
    assert np.abs(found.sdf[known == Status.SURFACE]).mean() < 0.2


def test_what_left_before_it_had_settled_is_learnt_once_there_is_nothing_else(
    kept: KeptMap,
) -> None:
    kept.visit(0, 1)
    kept.checkpoint()
    kept.leave()
    assert kept.mapper.regions.next_to_learn is None
    assert not kept.mapper.settled
    fetched = 0
    while not kept.mapper.settled:
        if kept.mapper.regions.next_to_learn:
            kept.mapper.train()
        else:
            assert kept.mapper.regions.fetch_unsettled()
            fetched += 1
    assert fetched == 2
    assert not kept.mapper.regions.fetch_unsettled()


def test_a_map_of_any_length_keeps_to_its_memory(tmp_path: Path) -> None:
    """And what it learnt first is there at the end, as in a map that had room for all."""
    waited = 0
    large, small = KeptMap(tmp_path / "large"), KeptMap(tmp_path / "small", LITTLE_BYTES)
    with closing(large.store), closing(small.store):
        for place in range(8):
            large.visit(place)
            try:
                small.visit(place)
            except NoRoomYetError:
                waited += 1
                assert small.mapper.regions.room.is_full
                small.checkpoint()
                assert not small.mapper.regions.room.is_full
                small.visit(place)
            assert small.mapper.regions.bytes_used <= LITTLE_BYTES
        whole, most = large.mapper.publish(), small.mapper.publish()
        assert waited > 2
        assert most.cold_regions > 4
        assert most.regions == whole.regions
        for place in range(8):
            np.testing.assert_array_equal(most.status(around(place)), whole.status(around(place)))


def test_where_no_checkpoint_is_written_scans_are_refused(tmp_path: Path) -> None:
    small = KeptMap(tmp_path, LITTLE_BYTES)
    small.mapper.regions.room.stored(None)
    with closing(small.store), pytest.raises(ScanRefusedError, match=r"--store") as refused:
        small.visit(*range(8))
    assert refused.value.reason == "map_full"


def test_a_restart_goes_on_with_all_regions_in_the_store(tmp_path: Path) -> None:
    first = KeptMap(tmp_path)
    with closing(first.store):
        first.visit(0, 1)
        first.checkpoint()
        before = first.mapper.publish()
    again = KeptMap(tmp_path)
    with closing(again.store):
        after = again.mapper.publish()
        assert after.cold_regions == after.regions == before.regions
        assert again.mapper.samples_left == first.mapper.samples_left
        points = around(1)
        np.testing.assert_array_equal(before.status(points), after.status(points))
        again.checkpoint()
        again.visit(1)
        again.checkpoint()
        assert again.mapper.publish().cold_regions < after.regions


def test_to_reset_a_part_of_a_region_that_left_reads_it_first(kept: KeptMap) -> None:
    kept.visit(0, 1)
    kept.checkpoint()
    kept.leave()
    place = np.array([APART_M, 0.0, 0.0])
    kept.mapper.reset(place + [-10.0, -10.0, 0.0], place + 10.0)
    found = kept.mapper.publish()
    points = around(1)
    upper = points[:, 2] > 0.3
    assert (found.status(points[upper]) == Status.UNKNOWN).all()
    assert (found.status(points[points[:, 2] < -0.3]) == Status.SURFACE).any()
    assert (found.status(around(0)) == Status.SURFACE).any()
    kept.mapper.reset(*NOWHERE)
    assert kept.mapper.publish().regions == 0


def test_what_leaves_and_comes_back_has_not_changed(kept: KeptMap) -> None:
    kept.visit(0, 1)
    settle(kept.mapper)
    history = SurfaceHistory(kept.mapper.publish(), CHANGES_KEPT)
    since = kept.mapper.publish().number
    kept.checkpoint()
    left = kept.leave()
    history.add(left)
    assert len(history.between(since, left.number).voxels) == 0
    kept.visit(0)
    again = kept.mapper.publish()
    history.add(again)
    changed = history.between(since, again.number)
    assert len(changed.voxels) == 0, "the scan showed what was known"


def test_a_checkpoint_has_the_map_as_it_was_when_it_began(kept: KeptMap) -> None:
    """However much is learnt before a region is copied."""
    kept.visit(0, 1)
    at_once = kept.mapper.snapshot_since(None).record()
    owed = kept.mapper.snapshot_since(None)
    kept.visit(0, 1, 1)
    for _ in range(5):
        kept.mapper.train()
    late = owed.record()
    for one, other in zip(at_once.regions, late.regions, strict=True):
        assert_same(other.tables, one.tables)
        assert_same(other.evidence, one.evidence)
        assert one.training is not None
        assert other.training is not None
        assert other.training.budget_samples == one.training.budget_samples
        assert_same(other.training.rays, one.training.rays)


def test_copies_that_wait_to_be_written_take_room_until_they_are(kept: KeptMap) -> None:
    kept.visit(0, 1)
    room = kept.mapper.regions.room
    snapshot = kept.mapper.snapshot_since(None)
    before, used = room.left, kept.mapper.regions.bytes_used
    kept.visit(0, 1)
    assert before - room.left > used / 2, "both regions were copied before they changed"
    for _ in snapshot.records():
        pass
    assert before - room.left < used / 4


def test_a_scan_waits_for_copies_that_take_its_room(tmp_path: Path) -> None:
    """Without a store that is written to, as while the map is downloaded."""
    with closing((kept := KeptMap(tmp_path, LITTLE_BYTES)).store):
        room = kept.mapper.regions.room
        room.stored(None)
        kept.visit(0)
        snapshot = kept.mapper.snapshot_since(None)
        kept.visit(0)
        with pytest.raises(NoRoomYetError):
            kept.visit(1)
        assert room.is_full
        for _ in snapshot.records():
            pass
        assert not room.is_full
        kept.visit(1)


def test_copies_that_nobody_took_are_let_go(kept: KeptMap) -> None:
    """Although the error of a checkpoint, where it is kept, keeps what that was made of."""
    kept.visit(0, 1)
    room = kept.mapper.regions.room
    with closing(kept.mapper.snapshot_since(None)) as snapshot:
        before = room.left
        kept.visit(0, 1)
        assert room.left < before
    assert room.left > before - kept.mapper.regions.bytes_used / 4
    assert not snapshot.changed


def test_a_copy_that_nobody_waits_for_any_more_holds_up_nothing(kept: KeptMap) -> None:
    kept.visit(0)
    owed = kept.mapper.snapshot_since(None)
    assert kept.mapper.regions.next_to_learn is None, "what waits for its copy is not trained"
    del owed
    assert kept.mapper.regions.next_to_learn


def test_a_cache_keeps_to_its_bytes_and_reads_each_region_once(kept: KeptMap) -> None:
    kept.visit(0, 1, 2)
    kept.checkpoint()
    kept.leave()
    reads: list[ColdRegion] = []
    regions = kept.store.regions

    def read(region: ColdRegion, topics: Collection[str]) -> MapRecord:
        reads.append(region)
        return regions.cache.read(region, topics)

    counted = RegionCache(read, lambda: 10**9, in_one)
    index, *_ = regions.known
    region = regions.known[index]
    begin = threading.Barrier(6)

    def ask(_: int) -> object:
        begin.wait()
        return counted.get(region)

    with ThreadPoolExecutor(6) as threads:
        got = list(threads.map(ask, range(6)))
    assert len({id(one) for one in got}) == 1
    assert len(reads) == 1
    small = RegionCache(regions.cache.read, lambda: 1, in_one)
    for one in regions.known.values():
        small.get(one)
    assert 0 < small.bytes < counted.bytes * len(regions.known), "the one read last alone"


def test_a_region_that_cannot_be_read_is_named_and_the_others_go_on(kept: KeptMap) -> None:
    kept.visit(0, 2)
    kept.checkpoint()
    epoch = kept.leave()
    broken = next(r for r in kept.store.regions.known.values() if r.index[0] == 0)
    for entry in broken.entries:
        (kept.store.folder / "parts" / entry.name).unlink()
    with pytest.raises(RefusedError, match=r"region \(0, 0, 0\) cannot be read"):
        epoch.query(around(0))
    with pytest.raises(ScanRefusedError, match="cannot be read") as refused:
        kept.visit(0)
    assert refused.value.reason == "store"
    assert (epoch.status(around(2)) == Status.SURFACE).any()
    kept.visit(2)
    while kept.mapper.regions.next_to_learn or kept.mapper.regions.fetch_unsettled():
        kept.mapper.train()
    with pytest.raises(RefusedError, match="reset its box to begin it again"):
        kept.mapper.publish().query(around(0))
    kept.mapper.reset(np.full(3, -30.0), np.full(3, 30.0))
    kept.visit(0)
    assert (kept.mapper.publish().status(around(0)) == Status.SURFACE).any()


def test_regions_leave_where_the_share_of_a_map_becomes_smaller(kept: KeptMap) -> None:
    kept.visit(0, 1, 2, 3)
    kept.checkpoint()
    regions, memory = kept.mapper.regions, kept.mapper.memory.server
    memory.limit = 2 * regions.bytes_used
    assert not regions.room.make_again()
    assert not regions.all.cold
    other = memory.open()
    assert regions.room.make_again()
    assert regions.room.left > 0
    assert regions.all.cold
    memory.close(other)
    assert not regions.room.make_again()
