"""Where a map has forgotten what it knew: told by rays that it was never trained on."""

import numpy as np
import pytest
from support.maps.small_world import (
    damage,
    settings,
    settle,
    settled_mapper,
    world,
)
from triquad_format.records import replay_rays
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.replay_rays import HELD_OUT
from triquad_map.field_fit import in_cube, place_keys
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.progress import map_fit
from triquad_server.mapping.replay.held_out import are_held_out, ends_in_steps
from triquad_server.mapping.replay.ray_table import END
from triquad_server.mapping.training.judgement import Judgement, Repairs

FIELD = FieldSettings()
NOISE_M = 0.02
RNG = np.random.default_rng(0)
# Of two places, a hundred metres apart.
ENDS = np.concatenate([RNG.uniform(0.1, 6.3, (400, 3)), RNG.uniform(100, 102, (300, 3))]).astype(
    np.float32
)
NOISE = RNG.normal(0, NOISE_M, len(ENDS))
FIRST, SECOND = np.arange(len(ENDS)) < 400, np.arange(len(ENDS)) >= 400


def judged(judgement: Judgement, error_m: np.ndarray, new: float = 0.0) -> list[int]:
    """The places to learn again, of a field that is off by ``error_m`` where noisy rays end.

    A share of them is ``new``.
    """
    are_new = np.random.default_rng(1).random(len(ENDS)) < new
    return judgement.judge(ENDS, (NOISE + error_m).astype(np.float32), are_new).tolist()


def off(at: np.ndarray, by_m: float) -> np.ndarray:
    """Off by so much, to either side of the surface."""
    return np.where(at, by_m, 0.0) * np.where(np.arange(len(at)) % 2, 1, -1)


def test_what_fits_worse_than_it_did_is_learnt_again() -> None:
    judgement = Judgement(FIELD, Repairs())
    assert not judged(judgement, off(FIRST, 0.005))
    (second,) = place_keys(ENDS[-1:], FIELD).tolist()
    assert judged(judgement, off(SECOND, 0.03)) == [second]
    assert judgement.repairing == 1
    assert not judged(judgement, off(FIRST, 0.005))
    assert judgement.repairs == Repairs(done=1)


def test_a_little_worse_again_and_again_is_told_in_the_end() -> None:
    judgement = Judgement(FIELD, Repairs())
    told = [bool(judged(judgement, off(SECOND, 0.001 * n))) for n in range(20)]
    assert not told[1]
    assert any(told)


def test_a_few_new_rays_tell_that_the_surface_moved() -> None:
    judgement = Judgement(FIELD, Repairs())
    judged(judgement, off(FIRST, 0.0))
    are_new = FIRST & (np.arange(len(ENDS)) < 40)
    moved = (NOISE + off(are_new, 0.08)).astype(np.float32)
    assert judgement.judge(ENDS, moved, are_new).tolist() == place_keys(ENDS[:1], FIELD).tolist()


def test_what_cannot_be_repaired_is_taken_as_it_is_until_new_rays_come() -> None:
    judgement = Judgement(FIELD, Repairs())
    judged(judgement, off(FIRST, 0.0))
    assert [len(judged(judgement, off(FIRST, 0.03))) for _ in range(5)] == [1, 1, 1, 0, 0]
    assert judgement.repairs == Repairs(done=0, given_up=1)
    assert not judged(judgement, off(FIRST, 0.06))
    assert judged(judgement, off(FIRST, 0.12), new=0.7)


@pytest.mark.parametrize("noise_m", [0.002, 0.02])
def test_a_rise_that_is_small_beside_the_noise_is_none(noise_m: float) -> None:
    noise = RNG.normal(0, noise_m, 100_000)
    ends = RNG.uniform(0.01, 0.3, (len(noise), 3)).astype(np.float32)
    side = np.where(np.arange(len(noise)) % 2, 1, -1)
    none = np.zeros(len(noise), np.bool_)

    def is_worse(share: float) -> bool:
        judgement = Judgement(FieldSettings(leaf_m=0.01), Repairs())
        judgement.judge(ends, noise, none)
        return bool(len(judgement.judge(ends, noise + share * noise_m * side, none)))

    assert not is_worse(0.6)  # 36 % of its square
    assert is_worse(0.8)


def test_one_ray_in_some_dozens_is_held_out_by_compiled_code_too() -> None:
    rows = RNG.uniform(-900, 900, (100_000, 4)).astype(np.float32)
    held = are_held_out(rows, FIELD)
    assert held.mean() == pytest.approx(1 / HELD_OUT, rel=0.1)
    assert (held == replay_rays.are_held_out(ends_in_steps(rows, FIELD))).all()


def test_rays_are_held_out_from_training_and_after_a_restart() -> None:
    mapper = Mapper("test", settings(), "cpu")
    for scan in world().scans:
        mapper.ingest(scan.points, scan.world_from_sensor)
    restarted = Mapper("test", settings(), "cpu", mapper.changes_since(None).record)
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
    fit = map_fit(mapper.regions)
    assert fit is not None
    assert fit.rays == inside


def test_a_map_that_forgets_again_and_again_settles() -> None:
    mapper = settled_mapper(settings(samples_per_ray=6.0), world(3))
    mapper.publish()
    rounds = 0
    while True:
        damage(mapper)
        settle(mapper)
        mapper.publish()  # judged, and learnt again
        if mapper.settled:
            break
        rounds += 1
    assert 1 <= rounds <= 4 * len(mapper.regions)
    fit = map_fit(mapper.regions)
    assert fit is not None
    assert fit.given_up > 0


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
