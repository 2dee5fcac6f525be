"""Rays that a map is never trained on: they tell how well it fits."""

import numpy as np
import pytest
from support.maps.small_world import mapper_of, settings, settled_mapper, world
from triquad_format.records import replay_rays
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.replay_rays import HELD_OUT
from triquad_map.field_fit import in_cube
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.replay.ray_table import END
from triquad_server.mapping.replay.replay_record import are_held_out

FIELD = FieldSettings()


def test_one_ray_in_some_dozens_is_held_out_by_compiled_code_too() -> None:
    rows = np.random.default_rng(0).uniform(-900, 900, (100_000, 4)).astype(np.float32)
    held = are_held_out(rows, FIELD)
    assert held.mean() == pytest.approx(1 / HELD_OUT, rel=0.1)
    leaves = rows[:, END : END + 3].astype(np.float64) / FIELD.leaf_m + (1 << FIELD.depth)
    ends = np.floor(leaves * replay_rays.STEPS).astype(np.int64)
    assert (held == replay_rays.are_held_out(ends)).all()


def test_rays_are_held_out_from_training_and_after_a_restart() -> None:
    mapper = mapper_of(*world().scans)
    restarted = Mapper("test", settings(), "cpu", mapper.snapshot_since(None).record())
    for region, again in zip(mapper.regions, restarted.regions, strict=True):
        assert are_held_out(region.training.rays.held_out.table.rows, settings().field).all()
        for kept in (region, again):
            table = kept.training.rays.pool.table
            trained = table.rows[table.origin_of >= 0]
            assert not are_held_out(trained, settings().field).any()
        counts = [len(of.training.rays.held_out) for of in (region, again)]
        assert counts[1] == pytest.approx(counts[0], rel=0.01)
    assert sum(len(region.training.rays.held_out) for region in mapper.regions) > 50


def test_a_region_is_not_judged_by_rays_that_end_beside_it() -> None:
    chosen = settings(samples_per_ray=2.0).model_copy(update={"field": FieldSettings(depth=6)})
    mapper = settled_mapper(chosen, world(2))
    mapper.publish()
    ends = [region.training.rays.held_out.table.rows[:, END : END + 3] for region in mapper.regions]
    inside = sum(in_cube(of_region, chosen.field).sum() for of_region in ends)
    assert inside < 0.95 * sum(map(len, ends))
    fit = mapper.regions.fit
    assert fit is not None
    assert fit.rays == inside


def test_where_all_rays_are_held_out_there_is_nothing_to_train_on() -> None:
    """Scans of a single point: some are held out, and nothing else is known."""
    ends = np.array([[5.0 + shift_m, 0.1, 0.1] for shift_m in np.arange(0, 0.2, 0.002)], np.float32)
    are_alone = are_held_out(np.insert(ends, 3, 0, axis=1), settings().field)
    alone = 0
    for end in (ends[are_alone][0], ends[~are_alone][0]):
        mapper = Mapper("test", settings(), "cpu")
        for _ in range(2):  # a single return is no surface yet
            mapper.ingest(end[None], np.eye(4))
        held = sum(len(region.training.rays.held_out) for region in mapper.regions)
        alone += held
        assert mapper.settled == (held == 1)
        mapper.train()
        mapper.publish()
    assert alone == 1
