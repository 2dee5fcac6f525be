"""What a map knows of itself goes on where a restart interrupts it; real files between."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.maps.small_world import damage, settings, settle, settled, surface_error, world
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapProgress, MapRecord
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.progress import map_fit

EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)
SCANS = 6


@cache
def learnt() -> MapRecord:
    """What the checkpoint of a short drive is made of."""
    return settled(SCANS).changes_since(None).record


@pytest.fixture
def restarted(tmp_path: Path) -> Mapper:
    """A mapper that goes on from the file of such a map."""
    path = tmp_path / "map.triquad"
    write_map(learnt(), path)
    return Mapper("test", settings(), "cpu", read_map(path))


def take_one_more(mapper: Mapper) -> None:
    scan = world(SCANS).scans[-1]
    mapper.ingest(scan.points, scan.world_from_sensor)


def test_a_download_without_training_state_tells_them_too(restarted: Mapper) -> None:
    assert restarted.publish().record().progress == learnt().progress


def test_a_map_that_was_reset_begins_anew(restarted: Mapper) -> None:
    restarted.reset(np.zeros(3), np.ones(3))
    assert restarted.progress == learnt().progress, "only a corner was forgotten"
    restarted.reset(*EVERYWHERE)
    assert restarted.publish().regions == 0
    assert restarted.changes_since(None).record.progress == MapProgress()
    take_one_more(restarted)
    assert restarted.scans_taken == 1


def test_what_the_field_forgets_after_a_restart_is_told(restarted: Mapper) -> None:
    before, before_m = map_fit(restarted.regions), surface_error(restarted.publish(), world(SCANS))
    damage(restarted)
    settle(restarted)
    forgetful_m = surface_error(restarted.publish(), world(SCANS))
    assert map_fit(restarted.regions).median_m > 1.2 * before.median_m
    assert forgetful_m > 1.2 * before_m
