"""Fields in arrays and in tensors are the same, however they grow and are kept."""

import numpy as np
import pytest
from support.maps import small_world
from triquad_format.records.field_settings import FieldSettings
from triquad_server.engine.compiled_trainer import trainer_of
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.live_field import Batch, LiveField, Parameter, initial_field
from triquad_server.engine.memory import Memory
from triquad_server.engine.tensor_field import TensorMemory
from triquad_server.epochs.buffers import buffers_of
from triquad_server.mapping.mapper import Mapper
from triquad_server.process.threads import Teams

SETTINGS = FieldSettings(depth=8, frequencies=4)
RATE = 0.01
IN_TENSORS = "cpu:0"  # as on a GPU, but where there is none
MEMORIES = (Memory(), TensorMemory(IN_TENSORS))
PARTS = ("values", "means", "variances", "steps")
POINTS = np.random.default_rng(0).uniform(-12, 12, (2000, 3)).astype(np.float32)
TEAM = Teams().mapping


def grown(memory: Memory) -> LiveField:
    """A field that grew twice and was trained between and after."""
    field = initial_field(SETTINGS, memory, 3)
    for points in np.split(POINTS, 2):
        field.grow(np.floor(points / SETTINGS.leaf_m).astype(np.int64) + 128)
        train(field)
    return field


def train(field: LiveField) -> None:
    batch = Batch(POINTS, 0.3 * np.sin(POINTS).sum(axis=1))
    float(trainer_of(field, GradientSums(), TEAM).train(batch, RATE))


def parts(field: LiveField) -> dict[str, np.ndarray]:
    """The numbers of the features and of their optimiser, copied."""
    memory = field.memory
    return {part: memory.array(getattr(field.features, part)).copy() for part in PARTS}


def test_they_start_grow_and_learn_alike() -> None:
    arrays, tensors = map(grown, MEMORIES)
    assert arrays.vertices == tensors.vertices
    mine, other = parts(arrays), parts(tensors)
    np.testing.assert_array_equal(mine["steps"], other["steps"])
    for part in ("values", "means", "variances"):
        # At a kink, rounding may choose the other side: all but a few must agree.
        error = np.abs(mine[part] - other[part])
        assert np.quantile(error, 0.999) < 1e-3 * np.abs(other[part]).max(), part


@pytest.mark.parametrize("memory", MEMORIES)
def test_growing_keeps_values_and_optimiser_state(memory: Memory) -> None:
    field = grown(memory)
    before, count = parts(field), len(field.features)
    side = np.arange(60, 90)
    field.grow(np.stack(np.meshgrid(side, side, [200]), -1).reshape(-1, 3))
    assert len(field.features) > count
    after = parts(field)
    for part in PARTS:
        np.testing.assert_array_equal(after[part][:count], before[part], err_msg=part)
        assert part == "values" or not after[part][count:].any()
    assert after["values"][count:].any()
    train(field)
    assert parts(field)["steps"].max() == 3, "the grown parameter is the one that is trained"


@pytest.mark.parametrize("memory", MEMORIES)
def test_a_frozen_field_stays_and_a_live_view_follows_the_training(memory: Memory) -> None:
    field = grown(memory)
    frozen, view = field.freeze(), field.live_view()
    before = frozen.evaluate(POINTS, gradient=False).sdf
    train(field)
    np.testing.assert_array_equal(frozen.evaluate(POINTS, gradient=False).sdf, before)
    # What is trained is a copy, since the frozen field has the numbers that the view saw.
    np.testing.assert_array_equal(view.evaluate(POINTS, gradient=False).sdf, before)
    view = field.live_view()
    once = view.evaluate(POINTS, gradient=False).sdf
    train(field)
    twice = view.evaluate(POINTS, gradient=False).sdf
    assert (once != before).any()
    assert (twice != once).any()
    np.testing.assert_array_equal(frozen.evaluate(POINTS, gradient=False).sdf, before)


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("more", [1, 2**16], ids=["into its room", "beyond it"])
def test_what_is_frozen_stays_where_rows_are_added_before_a_step(memory: Memory, more: int) -> None:
    parameter = Parameter(np.zeros((8, 4), np.float32), memory)
    parameter.append(np.ones((1000, 4), np.float32))
    frozen = parameter.freeze()
    kept = memory.array(frozen).copy()
    parameter.append(np.full((more, 4), 2, np.float32))
    is_copied = not np.shares_memory(memory.array(parameter.values), memory.array(frozen))
    assert is_copied == (more > 1)
    parameter.thaw()
    parameter.values[:] = 3
    np.testing.assert_array_equal(memory.array(frozen), kept)
    assert (memory.array(parameter.values) == 3).all()
    assert len(parameter) == 8 + 1000 + more


@pytest.mark.parametrize("memory", MEMORIES)
def test_an_epoch_takes_little_more_than_its_numbers(memory: Memory) -> None:
    parameter = Parameter(np.zeros((8, 4), np.float32), memory)
    for more in (1000, 700, 300):
        parameter.append(np.ones((more, 4), np.float32))
        parameter.freeze()
        parameter.thaw()
        frozen = parameter.freeze()
        (taken,) = buffers_of(frozen).values()
        used = memory.array(frozen).nbytes
        assert used <= taken <= 1.25 * used + 64


@pytest.mark.parametrize(
    ("device", "other"),
    [("cpu", IN_TENSORS), pytest.param(IN_TENSORS, "cpu", marks=pytest.mark.long)],
)
def test_a_map_is_learnt_in_either_and_goes_on_in_the_other(device: str, other: str) -> None:
    world, settings = small_world.world(3), small_world.settings()
    mapper = small_world.settled_mapper(settings, world, device)
    epoch = mapper.publish()
    assert small_world.surface_error(epoch, world) < 0.02
    again = Mapper("test", settings, other, mapper.snapshot_since(None).record())
    points = world.hits[:2000]
    before, after = (e.query(points, gradient=True) for e in (epoch, again.publish()))
    np.testing.assert_allclose(after.sdf, before.sdf, atol=2e-3)
    np.testing.assert_array_equal(after.status, before.status)
    small_world.take_in(again, *world.scans)
    small_world.settle(again)
    assert small_world.surface_error(again.publish(), world) < 0.02
