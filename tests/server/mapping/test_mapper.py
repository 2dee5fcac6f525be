"""Epochs, records and resets of a live map."""

from dataclasses import replace

import numpy as np
import pytest
from support.maps.map_records import assert_same
from support.maps.small_world import (
    damage,
    mapper_of,
    settings,
    settle,
    settled,
    settled_mapper,
    surface_error,
    take_in,
    world,
)
from triquad_format.records.region import MapProgress
from triquad_format.records.replay_rays import no_rays
from triquad_format.records.status import Status
from triquad_map.field_fit import in_cube
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.replay.kept_rays import RAY_BYTES
from triquad_server.mapping.replay.ray_table import END
from triquad_server.settings import Settings

EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)


@pytest.fixture(scope="module")
def mapped() -> Mapper:
    return settled()


def test_it_settles_and_then_changes_no_more(mapped: Mapper) -> None:
    assert mapped.settled
    first, trained = mapped.publish(), mapped.samples_trained
    mapped.train()
    assert mapped.samples_trained == trained
    assert mapped.publish() is first


def test_epochs_share_what_did_not_change_between_them() -> None:
    mapper = mapper_of(world().scans[0])
    mapper.train()
    before = mapper.publish()
    mapper.train()
    pairs = zip(before.frozen_regions, mapper.publish().frozen_regions, strict=True)
    ((old, new),) = [(old, new) for old, new in pairs if new is not old]  # what was trained
    assert len(before.frozen_regions) > 1
    assert new.evidence is old.evidence
    assert new.engine.tree is old.engine.tree


def test_a_record_restores_the_map_and_its_training(mapped: Mapper) -> None:
    epoch = mapped.publish()
    restarted = Mapper("test", settings(), "cpu", mapped.snapshot_since(None).record())
    restored = restarted.publish()
    assert restored.number == epoch.number
    points = world().hits[::40] + [0, 0, 0.02]
    np.testing.assert_allclose(
        restored.query(points, gradient=False).sdf,
        epoch.query(points, gradient=False).sdf,
        atol=1e-5,
    )
    np.testing.assert_array_equal(restored.status(points), epoch.status(points))
    assert restarted.regions.all.rays_kept > 0
    scan = world().scans[0]
    before = surface_error(restored, world())
    take_in(restarted, scan)
    restarted.train()
    during = surface_error(restarted.publish(), world())
    settle(restarted)
    after = surface_error(restarted.publish(), world())
    assert during < before + 0.005, "the optimiser goes on where it was"
    assert after < before + 0.004, "what the scan did not see is not forgotten"


def test_a_restarted_map_tells_what_it_was_made_of_until_all_of_it_is_reset(
    mapped: Mapper,
) -> None:
    record = mapped.snapshot_since(None).record()
    assert record.progress.scans_taken == len(world().scans)
    restarted = Mapper("test", settings(), "cpu", record)
    assert restarted.publish().record().progress == record.progress, "a download tells it, too"
    restarted.reset(np.zeros(3), np.ones(3))
    assert restarted.progress == record.progress, "only a corner was forgotten"
    restarted.reset(*EVERYWHERE)
    assert restarted.snapshot_since(None).record().progress == MapProgress()
    take_in(restarted, world().scans[-1])
    assert restarted.scans_taken == 1


def test_what_the_field_forgets_after_a_restart_is_told(mapped: Mapper) -> None:
    restarted = Mapper("test", settings(), "cpu", mapped.snapshot_since(None).record())
    before, before_m = restarted.regions.fit, surface_error(restarted.publish(), world())
    damage(restarted)
    settle(restarted)
    assert surface_error(restarted.publish(), world()) > 1.2 * before_m
    assert restarted.regions.fit.median_m > 1.2 * before.median_m


def test_the_records_of_a_moment_are_the_same_however_the_map_goes_on() -> None:
    # The pool of the one region is full: new rays take the places of those that were.
    chosen = Settings.model_validate({"training": {"pool_bytes": 4000 * RAY_BYTES}})
    first, *others = world().scans
    mapper = mapper_of(first, chosen=chosen)
    mapper.train()
    at_once = mapper.snapshot_since(None).record()
    snapshot = mapper.snapshot_since(None)
    for scan in others:
        take_in(mapper, scan)
        mapper.train()
    assert mapper.snapshot_since(None).record().progress != at_once.progress
    assert_same(snapshot.record(), at_once)


def test_a_record_with_nothing_to_train_on_has_no_training_budget() -> None:
    scan = world().scans[0]
    mapper = mapper_of(scan)
    record = mapper.snapshot_since(None).record()
    emptied = []
    for region in record.regions:
        state = region.training
        assert state is not None
        state = replace(
            state,
            sample_points=state.sample_points[:0],
            sample_labels=state.sample_labels[:0],
            rays=no_rays(),
        )
        emptied.append(replace(region, training=state))
    restarted = Mapper("test", settings(), "cpu", replace(record, regions=tuple(emptied)))
    assert restarted.settled
    take_in(restarted, scan)
    restarted.train()
    assert restarted.samples_trained > 0


def test_reset_forgets_a_box_and_everything() -> None:
    mapper = settled_mapper(settings(samples_per_ray=3.0), world(2))
    hits = world(2).hits
    low, high = np.array([-5.0, -50, -5]), np.array([0.0, 50, 50])
    settled_status = mapper.publish().status(hits)
    mapper.reset(low, high)
    status = mapper.publish().status(hits)
    inside = ((hits > low + 0.3) & (hits < high - 0.3)).all(axis=1)
    outside = ((hits < low - 0.3) | (hits > high + 0.3)).any(axis=1)
    assert inside.any()
    assert (status[inside] == Status.UNKNOWN).all()
    before = settled_status == Status.SURFACE  # not where far returns are alone
    assert (status[outside & before] == Status.SURFACE).mean() > 0.99
    assert before.mean() > 0.9
    for region in mapper.regions:
        for kept in (region.training.rays.pool, region.training.rays.held_out):
            ends = kept.table.rows[:, END : END + 3]
            ends = region.centre + ends[in_cube(ends, settings().field)]
            forgotten = ((ends > low + 0.01) & (ends < high - 0.01)).all(axis=1)
            assert not forgotten.any(), "rays that ended there are not trained on again"
    mapper.reset(*EVERYWHERE)
    assert mapper.publish().regions == 0
    assert mapper.regions.all.rays_kept == 0
    scan = world(2).scans[0]
    take_in(mapper, scan)
    assert mapper.publish().regions > 0
