"""Compiled code against tensors: values, gradients and training."""

import numpy as np
import pytest
import torch
from support.maps import small_world
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.field.encoding import load, locate, new_batch
from triquad_map.field.field import make_field
from triquad_map.field.frozen_field import in_grid
from triquad_server.engine.compiled_trainer import CompiledTrainer
from triquad_server.engine.field_record import field_from_record, region_record
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.live_field import Batch, LiveField, Parameter, initial_field
from triquad_server.engine.memory import Memory, memory_on
from triquad_server.engine.tensor_field import TensorField, tensors_of
from triquad_server.engine.tensor_trainer import (
    ParameterTensors,
    TensorTrainer,
    step_rows,
    step_where,
)
from triquad_server.process.threads import Teams

ARRAYS = Memory()
RATE = 0.01
TEAM = Teams().mapping
CASES = [
    FieldSettings(depth=8, frequencies=4),
    FieldSettings(depth=12),
    FieldSettings(depth=9, feature_size=5, feature_levels=2, hidden=17),
    FieldSettings(depth=8, encoding="features"),
    FieldSettings(depth=8, encoding="fourier"),
]


def trained(settings: FieldSettings) -> LiveField:
    field = initial_field(settings, ARRAYS, 3)
    batch = samples(settings, 4000)
    field.grow(leaves(settings, batch))
    trainer = TensorTrainer(field)
    for _ in range(3):
        trainer.train(batch, RATE)
    return field


def in_tensors(field: LiveField) -> TensorField:
    return TensorField(field.settings, field.tree, tensors_of(field))


def leaves(settings: FieldSettings, batch: Batch) -> np.ndarray:
    """The leaves of the batch's points, which lie inside the cube."""
    return np.floor(batch.points / settings.leaf_m).astype(np.int64) + 2 ** (settings.depth - 1)


def samples(settings: FieldSettings, count: int, seed: int = 0) -> Batch:
    half = min(12.0, settings.region_side_m * 0.49)
    points = np.random.default_rng(seed).uniform(-half, half, (count, 3)).astype(np.float32)
    return Batch(points, np.float32(0.3) * np.sin(points).sum(axis=1))


@pytest.mark.parametrize("settings", CASES)
def test_values_and_gradients_are_equal(settings: FieldSettings) -> None:
    field = trained(settings)
    points = samples(settings, 3000, seed=1).points
    slow = in_tensors(field).evaluate(points, gradient=True)
    fast = field.freeze().evaluate(points, gradient=True)
    np.testing.assert_allclose(fast.sdf, slow.sdf, atol=1e-5)
    # At a kink, rounding may choose the other side: all but a few must agree.
    error = np.abs(fast.gradient - slow.gradient).max(axis=1)
    assert np.quantile(error, 0.99) < 1e-4 * np.abs(slow.gradient).max()
    values_only = field.freeze().evaluate(points, gradient=False)
    np.testing.assert_array_equal(values_only.sdf, fast.sdf)
    assert len(values_only.gradient) == 0


@pytest.mark.parametrize("settings", CASES)
def test_a_training_step_is_equal(settings: FieldSettings) -> None:
    slow, fast = trained(settings), trained(settings)
    batch = samples(settings, 4096, seed=2)
    reference, trainer = TensorTrainer(slow), CompiledTrainer(fast, GradientSums(), TEAM)
    for step in range(3):
        loss = float(reference.train(batch, RATE))
        assert trainer.train(batch, RATE) == pytest.approx(loss, rel=1e-4), step
    np.testing.assert_array_equal(fast.features.steps, slow.features.steps)
    # The gradient's moments are what the step is made of.
    scale = float(np.abs(slow.features.means).max())
    # At a kink, rounding may choose the other side: all but a few must agree.
    error = np.abs(fast.features.means - slow.features.means)
    assert np.quantile(error, 0.99) <= 1e-3 * scale
    assert error.max() <= 0.05 * scale
    for part, other in zip(fast.mlp, slow.mlp, strict=True):
        np.testing.assert_allclose(part.means, other.means, atol=1e-4, rtol=1e-3)
        np.testing.assert_allclose(part.values, other.values, atol=1e-3)


@pytest.mark.parametrize("levels", [1, 3, 4])
def test_the_faces_of_the_cube_are_no_trap(levels: int) -> None:
    """Where rounding takes a point just outside, no vertex is looked for beyond its block."""
    for leaf_m in np.linspace(0.1, 0.5, 201):
        settings = FieldSettings(leaf_m=float(leaf_m), depth=6, feature_levels=levels, hidden=4)
        field = initial_field(settings, ARRAYS, 3)
        compiled = make_field(settings, field.tree, field.arrays)
        face = np.float32(-settings.region_side_m / 2)
        points = np.array([[face, face, face], [0, face, face], [face, 0, 0]], np.float32)
        near = np.concatenate([points, np.nextafter(points, np.float32(-1e9)), -points])
        batch = new_batch(levels, settings.feature_size, settings.input_size, settings.hidden)
        load(batch, near, 0)
        locate(batch, compiled.geometry, compiled.vertices, compiled.features)
        sides = np.array([(1 << (at % levels)) + 1 for at in range(3 * levels)])
        ends = np.cumsum([(1 << h) ** 2 + 2 * (1 << h) + 1 for h in range(levels)])
        last = ends[np.arange(3 * levels) % levels]
        assert (batch.corners.max(axis=1) + sides + 1 < last).all()


def test_no_points_give_no_values() -> None:
    field = trained(CASES[0])
    none = np.zeros((0, 3), np.float32)
    assert field.freeze().evaluate(none, gradient=True).gradient.shape == (0, 3)
    axes = np.zeros((3, 1), np.float32)
    assert field.freeze().evaluate_in_grid(axes, none.astype(np.int64)).shape == (0,)


@pytest.mark.parametrize("settings", CASES)
def test_in_a_grid_distances_are_those_of_its_points(settings: FieldSettings) -> None:
    field = trained(settings)
    rng = np.random.default_rng(0)
    half = settings.region_side_m / 2  # beyond the cube, too
    axes = np.sort(rng.uniform(-1.1 * half, 1.1 * half, (3, 70))).astype(np.float32)
    axes[:, 5:40] = np.linspace(-8, 8, 35, dtype=np.float32)
    points = rng.integers(0, 70, (3000, 3))
    points[:2000] = rng.integers(5, 40, (2000, 3))
    frozen = field.freeze()
    found = frozen.evaluate_in_grid(axes, points)
    for slow in (frozen, in_tensors(field)):
        expected = slow.evaluate(in_grid(axes, points), gradient=False).sdf
        np.testing.assert_allclose(found, expected, atol=1e-5)
    some = rng.permutation(3000)[:100]
    shifted = np.concatenate([axes[:, 7:], axes[:, :7]], axis=1)
    np.testing.assert_array_equal(
        frozen.evaluate_in_grid(shifted, (points[some] - 7) % 70), found[some]
    )


def test_a_step_over_all_rows_is_that_of_the_chosen() -> None:
    generator = torch.Generator().manual_seed(0)
    values = np.random.default_rng(0).standard_normal((50, 8), np.float32)
    chosen, masked = (ParameterTensors.of(Parameter(values, ARRAYS)) for _ in range(2))
    for _ in range(5):
        mask = torch.rand(50, generator=generator) < 0.4
        gradient = torch.randn((50, 8), generator=generator)
        rows = mask.nonzero()[:, 0]
        step_rows(chosen, rows, gradient[rows], RATE)
        step_where(masked, mask, gradient, RATE)
    assert torch.equal(chosen.steps, masked.steps)
    for name in ("values", "means", "variances"):
        torch.testing.assert_close(getattr(masked, name), getattr(chosen, name))


def test_the_tree_holds_the_vertices_of_all_nodes_and_no_others() -> None:
    settings = FieldSettings(depth=7, frequencies=4)
    field = initial_field(settings, ARRAYS, 0)
    chosen = np.random.default_rng(0).integers(0, 2**settings.depth, (3000, 3))
    for part in np.array_split(chosen, 7):
        field.grow(part)
    count = 0
    for plane, axes in enumerate(AXES):
        for h, level in enumerate(settings.levels):
            nodes = np.unique(chosen[:, list(axes)] >> (settings.depth - level), axis=0)
            corners = np.concatenate([nodes + (i, j) for i in (0, 1) for j in (0, 1)])
            codes, rows = field.tree.table(plane, h)
            np.testing.assert_array_equal(codes, np.unique(morton.encode(corners)))
            assert len(np.unique(rows)) == len(rows)
            count += len(rows)
    assert field.vertices == count


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_a_mapper_learns_on_the_gpu() -> None:
    world = small_world.world(3)
    mapper = small_world.settled_mapper(small_world.settings(), world, "cuda")
    assert small_world.surface_error(mapper.publish(), world) < 0.02


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_the_gpu_gives_the_same_values() -> None:
    settings = CASES[0]
    field, nothing = trained(settings), LiveEvidence(1 << settings.depth).freeze()
    record = region_record((0, 0, 0), field, nothing)
    other = field_from_record(record, settings, memory_on("cuda"), seed=0)
    points = samples(settings, 500, seed=1).points
    expected, values = (each.freeze().evaluate(points, gradient=True) for each in (field, other))
    np.testing.assert_allclose(values.sdf, expected.sdf, atol=1e-5)
    again = region_record((0, 0, 0), other.freeze(), nothing)
    for table, same in zip(record.tables, again.tables, strict=True):
        np.testing.assert_array_equal(table.features, same.features)
