"""The torch field against a point-by-point reference with Python dictionaries."""

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


def test_the_field_is_continuous_across_cells() -> None:
    field = grown(small())
    line = torch.linspace(-4, 4, 80_001)
    points = torch.stack([line, 0.37 * line, -0.21 * line + 0.1], 1)
    steps = in_tensors(field).sdf(points).diff().abs()
    assert steps.max() < 20 * steps.median() + 1e-5


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
