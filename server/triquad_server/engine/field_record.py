"""Between the field of a region and the plain arrays of its record."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import (
    AXES,
    Mlp,
    Region,
    RegionIndex,
    TrainingState,
    VertexTable,
)
from triquad_map.compiled.evidence.evidence import FrozenEvidence

from triquad_server.engine.batch import Batch
from triquad_server.engine.live_field import LiveField, StoredField


def region_record(
    index: RegionIndex,
    field: StoredField,
    evidence: FrozenEvidence,
    training: TrainingState | None,
) -> Region:
    """A region as plain arrays that share nothing with ``field`` and ``evidence``."""
    arrays = field.arrays
    tables = []
    for plane in range(len(AXES)):
        for h, level in enumerate(field.settings.levels):
            codes, rows = field.tree.table(plane, h)
            tables.append(VertexTable(plane, level, codes, arrays.features[rows]))
    mlp = [part.copy() for part in arrays.mlp]
    return Region(
        index=index,
        frequencies=arrays.frequencies.copy(),
        mlp=Mlp(tuple(mlp[0::2]), tuple(mlp[1::2])),
        tables=tuple(tables),
        evidence=evidence.record(),
        training=training,
    )


def training_state(field: LiveField, samples: Batch, budget_samples: int) -> TrainingState:
    """What training needs beyond the field itself, sharing nothing with it.

    Args:
        field: whose optimiser state is copied.
        samples: what is to be trained on again.
        budget_samples: how many samples are still to be trained on.
    """
    features = field.features
    rows = [
        torch.from_numpy(field.tree.table(plane, h)[1])
        for plane in range(len(AXES))
        for h in range(field.settings.feature_levels)
    ]
    mlp = field.mlp[0::2] + field.mlp[1::2]
    return TrainingState(
        table_means=tuple(_array(features.means[chosen]) for chosen in rows),
        table_variances=tuple(_array(features.variances[chosen]) for chosen in rows),
        table_steps=tuple(_array(features.steps[chosen]) for chosen in rows),
        mlp_means=tuple(_array(part.means[0]) for part in mlp),
        mlp_variances=tuple(_array(part.variances[0]) for part in mlp),
        mlp_steps=int(mlp[0].steps[0]),
        sample_points=_array(samples.points),
        sample_labels=_array(samples.labels).astype(np.float16),
        budget_samples=budget_samples,
    )


def field_from_record(
    record: Region,
    settings: FieldSettings,
    device: torch.device,
    seed: int,
) -> LiveField:
    """A field that answers as the recorded one and goes on training where it stopped."""
    layers = zip(record.mlp.weights, record.mlp.biases, strict=True)
    field = LiveField(
        settings,
        _tensor(record.frequencies, device),
        [_tensor(array, device) for layer in layers for array in layer],
        torch.Generator(device).manual_seed(seed),
    )
    for table in record.tables:
        h = table.level - settings.levels[0]
        features = _tensor(table.vectors(), device)
        field.restore(table.plane, h, table.codes.astype(np.int64), features)
    if record.training is not None:
        _restore_optimiser(field, record.training)
    return field


def _restore_optimiser(field: LiveField, state: TrainingState) -> None:
    device = field.device
    zero = torch.zeros((1, field.settings.feature_size), device=device)
    means = [_tensor(part.astype(np.float32), device) for part in state.table_means]
    variances = [_tensor(part.astype(np.float32), device) for part in state.table_variances]
    steps = [_tensor(part, device) for part in state.table_steps]
    field.features.restore(
        torch.cat([zero, *means]),
        torch.cat([zero, *variances]),
        torch.cat([zero[:, 0].int(), *steps]),
    )
    mlp = field.mlp[0::2] + field.mlp[1::2]
    for part, mean, variance in zip(mlp, state.mlp_means, state.mlp_variances, strict=True):
        taken = torch.full((1,), state.mlp_steps, dtype=torch.int32, device=device)
        part.restore(_tensor(mean, device)[None], _tensor(variance, device)[None], taken)


def _array(tensor: Tensor) -> NDArray[Any]:
    return np.array(tensor.detach().cpu().numpy())


def _tensor(array: NDArray[Any], device: torch.device) -> Tensor:
    return torch.tensor(array, device=device)
