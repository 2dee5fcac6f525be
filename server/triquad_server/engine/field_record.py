"""Between a live field and the plain arrays of its record."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import AXES, Mlp, Region, RegionIndex, TrainingState, VertexTable
from triquad_map.compiled.evidence.frozen_evidence import FrozenEvidence

from triquad_server.engine.adam import Parameter
from triquad_server.engine.field import Field


@dataclass(frozen=True)
class Moments:
    """The optimiser's state of a field, in the order of its record."""

    table_means: tuple[NDArray[np.float32], ...]
    table_variances: tuple[NDArray[np.float32], ...]
    table_steps: tuple[NDArray[np.int32], ...]
    mlp_means: tuple[NDArray[np.float32], ...]
    mlp_variances: tuple[NDArray[np.float32], ...]
    mlp_steps: int

    def as_fields(self) -> dict[str, Any]:
        """The moments by name, as :class:`triquad_format.records.region.TrainingState` has them."""
        return dict(vars(self))


def region_record(
    index: RegionIndex,
    field: Field,
    evidence: FrozenEvidence,
    training: TrainingState | None,
) -> Region:
    """A region as plain arrays that share nothing with ``field`` and ``evidence``."""
    return Region(
        index=index,
        frequencies=_array(field.frequencies),
        mlp=field_mlp(field),
        tables=field_tables(field),
        evidence=evidence.record(),
        training=training,
    )


def field_tables(field: Field) -> tuple[VertexTable, ...]:
    """The vertices of a field with their features, plane by plane, coarsest level first."""
    tables = []
    for plane in range(len(AXES)):
        for h, level in enumerate(field.settings.levels):
            codes, rows = field.tree.table(plane, h)
            features = field.features.values[torch.from_numpy(rows)]
            tables.append(VertexTable(plane, level, codes, _array(features)))
    return tuple(tables)


def field_mlp(field: Field) -> Mlp:
    """The decoder's weights."""
    parts = [_array(part.values[0]) for part in field.mlp]
    return Mlp(tuple(parts[0::2]), tuple(parts[1::2]))


def training_moments(field: Field) -> Moments:
    """The optimiser's state."""
    features = field.features
    rows = [
        torch.from_numpy(field.tree.table(plane, h)[1])
        for plane in range(len(AXES))
        for h in range(field.settings.feature_levels)
    ]
    mlp = field.mlp[0::2] + field.mlp[1::2]
    return Moments(
        tuple(_array(features.means[chosen]) for chosen in rows),
        tuple(_array(features.variances[chosen]) for chosen in rows),
        tuple(_array(features.steps[chosen]) for chosen in rows),
        tuple(_array(part.means[0]) for part in mlp),
        tuple(_array(part.variances[0]) for part in mlp),
        int(mlp[0].steps[0]),
    )


def field_from_record(
    record: Region,
    settings: FieldSettings,
    device: torch.device,
    seed: int,
) -> Field:
    """A field that answers as the recorded one and goes on training where it stopped."""
    field = Field(settings, device, seed)
    field.frequencies = _tensor(record.frequencies, device)
    for table in record.tables:
        h = table.level - settings.levels[0]
        features = _tensor(table.vectors(), device)
        field.restore(table.plane, h, table.codes.astype(np.int64), features)
    parts = zip(record.mlp.weights, record.mlp.biases, strict=True)
    field.mlp = [Parameter(_tensor(array, device)[None]) for pair in parts for array in pair]
    if record.training is not None:
        _restore_moments(field, record, device)
    return field


def _restore_moments(field: Field, record: Region, device: torch.device) -> None:
    state = record.training
    assert state is not None
    zero = torch.zeros((1, field.settings.feature_size), device=device)
    field.features.restore(
        torch.cat(
            [zero, *(_tensor(part.astype(np.float32), device) for part in state.table_means)]
        ),
        torch.cat(
            [zero, *(_tensor(part.astype(np.float32), device) for part in state.table_variances)]
        ),
        torch.cat([zero[:, 0].int(), *(_tensor(part, device) for part in state.table_steps)]),
    )
    mlp = field.mlp[0::2] + field.mlp[1::2]
    for part, mean, variance in zip(mlp, state.mlp_means, state.mlp_variances, strict=True):
        steps = torch.full((1,), state.mlp_steps, dtype=torch.int32, device=device)
        part.restore(_tensor(mean, device)[None], _tensor(variance, device)[None], steps)


def _array(tensor: Tensor) -> NDArray[Any]:
    return np.array(tensor.detach().cpu().numpy())


def _tensor(array: NDArray[Any], device: torch.device) -> Tensor:
    return torch.tensor(array, device=device)
