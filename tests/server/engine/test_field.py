"""The torch field against a point-by-point reference with Python dictionaries."""

import math

import numpy as np
import pytest
import torch
from triquad_format.records import morton
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES
from triquad_map.compiled.evidence.live_evidence import LiveEvidence
from triquad_server.engine.field_record import field_from_record, region_record
from triquad_server.engine.live_field import Batch, LiveField, Rates, initial_field
from triquad_server.engine.memory import memory_on
from triquad_server.engine.tensor_field import FieldTensors, TensorField, TensorMemory
from triquad_server.engine.tensor_trainer import TensorTrainer

TENSORS = TensorMemory("cpu")
RATES = Rates(learning_rate=0.01, young_rate=0.02)


def small(encoding: str = "both", depth: int = 8) -> FieldSettings:
    return FieldSettings(depth=depth, frequencies=4, encoding=encoding)


def grown(settings: FieldSettings, seed: int = 0, points: int = 300) -> LiveField:
    field = initial_field(settings, TENSORS, seed)
    generator = torch.Generator().manual_seed(seed)
    half = settings.region_side_m / 2
    field.grow(
        leaves(settings, (torch.rand((points, 3), generator=generator) * 2 - 1) * half * 0.3)
    )
    field.features.values[1:] *= 20  # so that features matter
    return field


def leaves(settings: FieldSettings, points: torch.Tensor) -> np.ndarray:
    """The leaves [N, 3] that hold points, which lie inside the cube."""
    return np.floor(points.numpy() / settings.leaf_m).astype(np.int64) + 2 ** (settings.depth - 1)


def in_tensors(field: LiveField) -> TensorField:
    return TensorField(field.settings, field.tree, FieldTensors.of(field))


def train(field: LiveField, points: torch.Tensor, labels: torch.Tensor) -> None:
    TensorTrainer(field).train(Batch(points, labels), RATES)


def slow_sdf(field: LiveField, point: np.ndarray) -> float:
    settings = field.settings
    inputs: list[float] = []
    record = region_record(
        (0, 0, 0), field, LiveEvidence(1 << settings.depth).freeze(), training=None
    )
    tables = {
        (table.plane, table.level): {
            int(code): features for code, features in zip(table.codes, table.features, strict=True)
        }
        for table in record.tables
    }
    if settings.encoding != "fourier":
        leaf = point / settings.leaf_m + 2 ** (settings.depth - 1)
        for level in settings.levels:
            total = np.zeros(settings.feature_size)
            for plane, axes in enumerate(AXES):
                uv = leaf[list(axes)] / 2 ** (settings.depth - level)
                cell, t = np.floor(uv).astype(int), uv - np.floor(uv)
                for i in (0, 1):
                    for j in (0, 1):
                        code = int(morton.encode(cell + [i, j]))
                        weight = (t[0] if i else 1 - t[0]) * (t[1] if j else 1 - t[1])
                        total += weight * tables[plane, level].get(code, np.zeros(1))
            inputs.extend(total)
    if settings.encoding != "features":
        angles = [
            2 * math.pi * s * q
            for q in point / (settings.region_side_m / 2)
            for s in field.arrays.frequencies.tolist()
        ]
        inputs.extend([math.sin(a) for a in angles] + [math.cos(a) for a in angles])
    x = np.array(inputs)
    mlp = record.mlp
    for layer, (weight, bias) in enumerate(zip(mlp.weights, mlp.biases, strict=True)):
        x = x @ weight + bias
        if layer < 2:
            x = np.maximum(x, 0)
    return float(x[0] * settings.logit_scale_m)


@pytest.mark.parametrize("encoding", ["both", "features", "fourier"])
def test_it_equals_the_slow_reference(encoding: str) -> None:
    field = grown(small(encoding))
    points = (torch.rand((60, 3)) * 2 - 1) * field.settings.region_side_m * 0.2
    expected = [slow_sdf(field, point) for point in points.double().numpy()]
    np.testing.assert_allclose(in_tensors(field).sdf(points).numpy(), expected, atol=1e-5)


def test_the_gradient_is_that_of_the_values() -> None:
    field = grown(small())
    points = (torch.rand((200, 3)) * 2 - 1) * field.settings.region_side_m * 0.2
    # Bilinear cells and ReLUs have kinks; stay within cells and compare the bulk.
    tensors = in_tensors(field)
    _, gradient = tensors.sdf_and_gradient(points)
    step = 1e-3
    for axis in range(3):
        offset = torch.zeros(3)
        offset[axis] = step
        slope = (tensors.sdf(points + offset) - tensors.sdf(points - offset)) / (2 * step)
        error = (slope - gradient[:, axis]).abs()
        assert error.median() < 2e-3 * gradient.abs().median()


def test_the_field_is_continuous_across_cells() -> None:
    field = grown(small())
    line = torch.linspace(-4, 4, 80_001)
    points = torch.stack([line, 0.37 * line, -0.21 * line + 0.1], 1)
    steps = in_tensors(field).sdf(points).diff().abs()
    assert steps.max() < 20 * steps.median() + 1e-5


def test_vertices_are_those_of_the_nodes_that_points_project_into() -> None:
    settings = small()
    field = initial_field(settings, TENSORS, 0)
    field.grow(np.array([[70, 80, 90]]))
    assert field.vertices == 3 * settings.feature_levels * 4
    field.grow(np.array([[70, 80, 90]] * 3))
    assert field.vertices == 3 * settings.feature_levels * 4, "the same nodes again"


def test_the_tree_holds_the_vertices_of_all_nodes_and_no_others() -> None:
    settings = small(depth=7)
    field = initial_field(settings, TENSORS, 0)
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, 2**settings.depth, (3000, 3))
    for part in np.array_split(chosen, 7):
        field.grow(part)
    for plane, axes in enumerate(AXES):
        for h, level in enumerate(settings.levels):
            nodes = chosen[:, list(axes)] >> (settings.depth - level)
            expected = {
                int(morton.encode(node + [i, j]))
                for node in np.unique(nodes, axis=0)
                for i in (0, 1)
                for j in (0, 1)
            }
            codes, rows = field.tree.table(plane, h)
            assert codes.tolist() == sorted(expected)
            assert len(np.unique(rows)) == len(rows)
    assert field.vertices == sum(
        len(field.tree.table(plane, h)[0]) for plane in range(3) for h in range(3)
    )


def test_growing_keeps_values_and_optimiser_state() -> None:
    field = grown(small())
    points = (torch.rand((2000, 3)) * 2 - 1) * 7
    train(field, points, points[:, 2])
    before = [t.clone() for t in (field.features.values, field.features.means)]
    variances, steps = field.features.variances.clone(), field.features.steps.clone()
    count = len(field.features)
    assert steps.max() == 1
    field.grow(leaves(field.settings, (torch.rand((500, 3)) * 2 - 1) * 12))
    assert len(field.features) > count
    assert torch.equal(field.features.values[:count], before[0])
    assert torch.equal(field.features.means[:count], before[1])
    assert torch.equal(field.features.variances[:count], variances)
    assert torch.equal(field.features.steps[:count], steps)
    assert field.features.steps[count:].max() == 0
    train(field, points, points[:, 2])
    assert field.features.steps.max() == 2, "the grown parameter is the one that is trained"


@pytest.mark.parametrize("encoding", ["both", "features", "fourier"])
def test_training_learns_a_plane(encoding: str) -> None:
    settings = small(encoding, depth=7)
    field = initial_field(settings, TENSORS, 1)
    generator = torch.Generator().manual_seed(1)
    ground = (torch.rand((4000, 3), generator=generator) * 2 - 1) * torch.tensor([6.0, 6.0, 0.0])
    field.grow(leaves(settings, ground))
    for _ in range(150):
        chosen = torch.randint(len(ground), (2048,), generator=generator)
        height = (torch.rand(2048, generator=generator) * 2 - 1) * 0.3
        points = ground[chosen] + height[:, None] * torch.tensor([0.0, 0.0, 1.0])
        train(field, points, height)
    inner = ground[ground.abs().amax(1) < 5][:500]
    above = in_tensors(field).sdf(inner + torch.tensor([0.0, 0.0, 0.05]))
    below = in_tensors(field).sdf(inner - torch.tensor([0.0, 0.0, 0.05]))
    assert (above > 0).float().mean() > 0.97
    assert (below < 0).float().mean() > 0.97


def test_absent_vertices_stay_zero() -> None:
    field = grown(small())
    points = (torch.rand((3000, 3)) * 2 - 1) * field.settings.region_side_m * 0.45
    train(field, points, points[:, 0])
    assert not field.features.values[0].any()


def test_a_frozen_field_does_not_change() -> None:
    field = grown(small())
    points = (torch.rand((500, 3)) * 2 - 1) * 7
    before = field.freeze().evaluate(points.numpy(), gradient=False).sdf
    frozen = field.freeze()
    train(field, points, points[:, 2])
    field.grow(leaves(field.settings, points))
    np.testing.assert_array_equal(frozen.evaluate(points.numpy(), gradient=False).sdf, before)
    assert (field.freeze().evaluate(points.numpy(), gradient=False).sdf != before).any()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_the_gpu_gives_the_same_values() -> None:
    field = grown(small())
    record = region_record(
        (0, 0, 0), field, LiveEvidence(1 << field.settings.depth).freeze(), training=None
    )
    other = field_from_record(record, field.settings, memory_on("cuda"), seed=0)
    points = (torch.rand((500, 3)) * 2 - 1).numpy() * 7
    expected = field.freeze().evaluate(points, gradient=True)
    values = other.freeze().evaluate(points, gradient=True)
    np.testing.assert_allclose(values.sdf, expected.sdf, atol=1e-5)
    again = region_record((0, 0, 0), other.freeze(), LiveEvidence(1 << 8).freeze(), training=None)
    for table, same in zip(record.tables, again.tables, strict=True):
        np.testing.assert_array_equal(table.features, same.features)
