"""A robot at rest: once the rays of a place make it no better, they owe no training."""

from functools import partial
from itertools import count

import numpy as np
from support.maps.small_world import WALLED, WALLED_BOUNDS, settle
from triquad_format.records.arrays import Bools, Doubles, Floats
from triquad_format.records.field_settings import FieldSettings
from triquad_server.mapping.mapper import Mapper
from triquad_server.mapping.training.learnt_places import VISITS, LearntPlaces
from triquad_server.settings import Settings
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box

FIELD = FieldSettings()
RNG = np.random.default_rng(0)
# Of two places, a hundred metres apart.
ENDS = np.concatenate([RNG.uniform(0.1, 6.3, (400, 3)), RNG.uniform(100, 102, (300, 3))]).astype(
    np.float32
)
ALL = ENDS.astype(np.float64)
FIRST = np.arange(len(ENDS)) < 400
NOISE = RNG.normal(0, 0.02, len(ENDS))

BOX = box((5.0, 0.5, 0.45), (0.6, 0.9, 0.45))
FRONT = np.column_stack([np.full(60, 4.4), RNG.uniform(-0.3, 1.3, 60), RNG.uniform(0.3, 0.8, 60)])


def at_ends(sdf: Doubles, points: Floats) -> Floats:
    """What a field says at some of the ends, that says ``sdf`` [N] at all of them."""
    rows = [int(np.flatnonzero((point == ENDS).all(axis=1))[0]) for point in points]
    return sdf[rows].astype(np.float32)


no_field = partial(at_ends, np.zeros(len(ENDS)))


def judged(places: LearntPlaces, error_m: Doubles, seen: Bools | slice = slice(None)) -> None:
    """Some rays are seen, all are trained on, and the field is off by ``error_m`` [N]."""
    sdf = NOISE + error_m
    places.see(ALL[seen])
    places.trained(VISITS)
    places.judge(ENDS, sdf, partial(at_ends, sdf), settled=False)


def off(first_m: float, second_m: float) -> Doubles:
    """By so much in each of the places, to either side of the surface."""
    return np.where(FIRST, first_m, second_m) * np.where(np.arange(len(ENDS)) % 2, 1, -1)


def learnt() -> LearntPlaces:
    """Both places are learnt."""
    places = LearntPlaces(FIELD)
    for _ in range(4):
        judged(places, off(0.01, 0.01))
    assert len(places) == 2
    return places


def test_what_no_longer_gets_better_is_learnt() -> None:
    places = LearntPlaces(FIELD)
    assert places.need_training(ALL).all()
    for look in range(4):
        judged(places, off(0.01, 0.2 / 2**look))
    assert (places.need_training(ALL) == ~FIRST).all()
    for _ in range(3):
        judged(places, off(0.01, 0.01))
    assert not places.need_training(ALL).any()


def test_where_surface_goes_all_is_to_be_learnt() -> None:
    places = learnt()
    places.surface_removed(ALL[[0, 1, -1]])
    assert not places.need_training(ALL).any(), "single voxels may have held noise"
    places.surface_removed(ALL[:3])
    assert places.need_training(ALL).all()


def test_where_the_rays_fit_no_more_all_is_to_be_learnt() -> None:
    """As where a surface moved by less than a voxel."""
    places = learnt()
    places.judge(ENDS, NOISE + off(0.01, 0.04), no_field, settled=False)
    assert not places.need_training(ALL).any(), "what is being trained may waver"
    places.judge(ENDS, NOISE + off(0.01, 0.01), no_field, settled=True)
    assert not places.need_training(ALL).any()
    places.judge(ENDS, NOISE + off(0.01, 0.04), no_field, settled=True)
    assert places.need_training(ALL).all()


def test_one_place_that_cannot_be_learnt_does_not_decide_for_all_that_have_few_rays() -> None:
    places = LearntPlaces(FIELD)
    scattered = RNG.uniform(-300, 300, (60, 3)).astype(np.float32)
    needing = []
    for step in range(8):
        for _ in range(4):
            places.see(scattered.astype(np.float64))
        places.trained(VISITS)
        said = np.full(60, max(0.025, 0.4 / 2**step))  # better by half four times
        said[0] = 2.0  # as where leaves move
        places.judge(scattered, said, lambda points, said=said: said[: len(points)], settled=False)
        needing.append(places.need_training(scattered).mean())
    assert needing == [1.0] * 6 + [0.0] * 2


def test_the_map_of_a_robot_at_rest_settles_and_learns_what_is_put_before_it() -> None:
    few = {"pool_rays": 60_000, "rays_per_voxel": 1, "max_budget_samples": 400_000}
    training = {"batch": 4096, "samples_per_voxel": 20, **few}
    mapper = Mapper("test", Settings.model_validate({"training": training}), "cpu")
    pose = np.eye(4)
    pose[:3, 3] = (0.3, 0.2, 1.4)
    numbers = count()

    def scan(*there: Solid) -> int:
        """Returns how many samples were trained on, of 80,000 that there is time for."""
        scene = Scene((*WALLED, *there), WALLED_BOUNDS)
        made = Lidar(columns=512).scan(scene, pose, np.random.default_rng(next(numbers)))
        before = mapper.samples_trained
        mapper.ingest(made.points, pose)
        for _ in range(20):
            mapper.train()
        mapper.publish()
        return mapper.samples_trained - before

    while sum(scan() for _ in range(10)) > 20_000:
        assert next(numbers) < 300, "it never settles"
    assert np.mean([scan() for _ in range(20)]) < 2_000
    assert np.mean([scan(BOX) for _ in range(5)]) > 10_000
    settle(mapper)
    assert np.abs(mapper.publish().query(FRONT).sdf).mean() < 0.03
