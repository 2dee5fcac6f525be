"""The map keeps to its memory: what is new is refused, what is known is taken on."""

import numpy as np
import pytest
from support.maps.small_world import settings
from support.poses import shifted
from support.servers import sphere
from triquad_server.errors import ScanRefusedError
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import MemorySettings

LIMIT = 8_000_000


def mapper(limit: int = LIMIT) -> Mapper:
    chosen = settings().model_copy(update={"memory": MemorySettings(max_bytes=limit)})
    return Mapper("test", chosen, "cpu")


def filled() -> tuple[Mapper, float]:
    """A full map, and where the first scan was taken that did not fit."""
    full = mapper()
    for x in np.arange(0, 400, 8.0):
        try:
            full.ingest(sphere(), shifted(x))
        except ScanRefusedError:
            return full, float(x)
    raise AssertionError(f"never full: {full.regions.bytes_used} bytes")


def test_a_scan_that_does_not_fit_is_refused_and_changes_nothing() -> None:
    full, x = filled()
    used, epoch = full.regions.bytes_used, full.publish()
    assert 0.5 * LIMIT < used <= LIMIT
    with pytest.raises(ScanRefusedError, match=r"memory\.max_bytes = 8000000") as refusal:
        full.ingest(sphere(), shifted(x))
    assert refusal.value.reason == "map_full"
    assert full.regions.bytes_used == used
    assert full.publish() is epoch


def test_a_full_map_goes_on_to_take_scans_of_what_it_knows() -> None:
    full, _ = filled()
    for _ in range(3):
        full.ingest(sphere(), shifted(0.0))
    assert full.regions.bytes_used <= LIMIT


def take_open_rays(full: Mapper) -> None:
    """Scans along a way that see next to nothing but free space."""
    directions = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    few = np.array([[4.0, 0.0, 0.0]], np.float32)
    for x in np.arange(0, 2000, 20.0):
        full.ingest(few, shifted(x), no_return=directions)


def test_free_space_counts_too() -> None:
    full = mapper()
    with pytest.raises(ScanRefusedError, match="max_bytes") as refusal:
        take_open_rays(full)
    assert refusal.value.reason == "map_full"
    assert full.regions.bytes_used <= LIMIT


def test_room_comes_back_with_a_reset() -> None:
    full, x = filled()
    full.reset(np.full(3, -np.inf), np.full(3, np.inf))
    assert full.regions.bytes_used == 0
    full.ingest(sphere(), shifted(x))
