"""A scan that fails midway leaves nothing of itself in the map."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from support.servers import SMALL, scan, sphere
from triquad_format.records.status import Status
from triquad_server.errors import MapLostError, ScanRefusedError
from triquad_server.intake.scan_queue import ScanQueue
from triquad_server.mapping.live_region import LiveRegion
from triquad_server.mapping.mapper import Mapper

HERE = np.eye(4)
THERE = np.eye(4) + np.eye(4, k=3) * np.array([[8.0], [0], [0], [0]])
PROBES = np.concatenate([sphere(500), sphere(500) + THERE[:3, 3]])


@pytest.fixture
def mapper() -> Mapper:
    """One that has published a sphere."""
    mapper = Mapper("test", SMALL, "cpu")
    for _ in range(3):
        mapper.ingest(sphere(), HERE)
    while not mapper.settled:
        mapper.train()
    mapper.publish()
    return mapper


def fail_midway(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(LiveRegion, "learn", fail)


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("a defect")])
def test_nothing_of_it_is_published(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    before = mapper.publish()
    with monkeypatch.context() as patched:
        fail_midway(patched, error)
        with pytest.raises((ScanRefusedError, RuntimeError)) as raised:
            mapper.ingest(sphere(), THERE)
    if isinstance(error, MemoryError):
        assert isinstance(raised.value, ScanRefusedError)
        assert raised.value.reason == "out_of_memory"
    after = mapper.publish()
    assert mapper.scans_taken == 3
    assert {r.index for r in after.frozen_regions} == {r.index for r in before.frozen_regions}
    then, now = (epoch.query(PROBES, gradient=False) for epoch in (before, after))
    assert np.array_equal(now.status, then.status)
    assert np.array_equal(now.sdf, then.sdf, equal_nan=True)


def test_the_map_goes_on_after_it(mapper: Mapper, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        fail_midway(patched, MemoryError())
        with pytest.raises(ScanRefusedError):
            mapper.ingest(sphere(), THERE)
    for _ in range(2):
        mapper.ingest(sphere(), THERE)
    while not mapper.settled:
        mapper.train()
    sdf = mapper.publish().query(PROBES, gradient=False).sdf
    assert np.abs(sdf).mean() < 0.1


def test_a_map_that_cannot_be_restored_is_told_as_lost(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_midway(monkeypatch, RuntimeError("a defect"))
    monkeypatch.setattr(LiveRegion, "restore", lambda *_: 1 / 0)
    with pytest.raises(MapLostError):
        mapper.ingest(sphere(), THERE)


@pytest.mark.parametrize("take", [lambda: bytes(2**60), lambda: torch.empty(2**58)])
def test_a_map_for_which_memory_is_short_comes_back_when_there_is_some(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch, take: Callable[[], object]
) -> None:
    before = mapper.publish()
    with monkeypatch.context() as patched:
        fail_midway(patched, MemoryError())
        patched.setattr(LiveRegion, "restore", lambda *_: take())
        for _ in range(2):
            with pytest.raises(ScanRefusedError, match="memory"):
                mapper.ingest(sphere(), THERE)
        assert not mapper.settled
        with pytest.raises(MemoryError):
            mapper.publish()
    after = mapper.publish()
    then, now = (epoch.query(PROBES, gradient=False) for epoch in (before, after))
    assert np.array_equal(now.sdf, then.sdf, equal_nan=True)
    mapper.ingest(sphere(), THERE)
    assert (mapper.publish().query(PROBES, gradient=False).status == Status.SURFACE).all()


def test_an_epoch_that_fails_midway_is_made_up_for_by_the_next(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper.ingest(sphere(), THERE)
    with monkeypatch.context() as patched:
        patched.setattr(LiveRegion, "_forget_gone", lambda *_: bytes(2**60))
        with pytest.raises(MemoryError):
            mapper.publish()
    statuses = mapper.publish().query(PROBES, gradient=False).status
    assert (statuses == Status.SURFACE).all()


def test_scans_that_no_epoch_shows_are_counted_as_refused_with_it() -> None:
    ledger = ScanQueue(8).ledger
    for sequence in range(4):
        ledger.arrive(scan(sequence))
        ledger.take(scan(sequence))
        if sequence == 1:
            ledger.publish()
    assert ledger.take_back("no memory") == 2
    reply = ledger.outcome("lidar", 7, 3)
    assert reply is not None
    assert (reply.taken, reply.refused) == (2, 2)
    assert reply.last_refusal == "scan 2 and later ones: no memory"
    assert ledger.take_back("no memory") == 0


def test_a_scan_of_free_space_alone_is_undone_too(
    mapper: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_midway(monkeypatch, MemoryError())
    nothing = np.zeros((0, 3), np.float32)
    with pytest.raises(ScanRefusedError, match="no more memory"):
        mapper.ingest(nothing, HERE, no_return=sphere(50))
