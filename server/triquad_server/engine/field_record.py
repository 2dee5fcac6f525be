"""Converts a field to the plain arrays of a region's record, and back."""

import numpy as np
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings, RegionIndex
from triquad_format.records.region import AXES, Mlp, Region, TrainingState, VertexTable
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.evidence.live_evidence import LiveEvidence
from triquad_map.field.frozen_field import FrozenField

from triquad_server.engine.live_field import LiveField
from triquad_server.engine.memory import Memory

_VARIANCE_BITS = 3  # that follow the first, in a checkpoint


def region_record(
    index: RegionIndex,
    field: LiveField | FrozenField,
    evidence: FrozenEvidence | LiveEvidence,
) -> Region:
    """Return a region as plain arrays that share nothing with ``field`` and ``evidence``.

    It has no training state.
    """
    arrays = field.arrays
    tables = []
    for plane in range(len(AXES)):
        for h, level in enumerate(field.settings.levels):
            codes, rows = field.tree.table(plane, h)
            tables.append(VertexTable(plane, level, codes, features=arrays.features[rows]))
    mlp = [part.copy() for part in arrays.mlp]
    return Region(
        index=index,
        frequencies=arrays.frequencies.copy(),
        mlp=Mlp(tuple(mlp[0::2]), tuple(mlp[1::2])),
        tables=tuple(tables),
        evidence=evidence.record(),
        training=None,
    )


def training_state(field: LiveField, budget_samples: int) -> TrainingState:
    """Return what training needs beyond the field, rays and samples, as copies.

    Of the vertices' moments the means are left out, which forget in some ten steps, and the
    variances are rounded: that changes steps by at most 3 %, and takes a seventh of the bytes.

    Args:
        field: whose optimiser state is copied.
        budget_samples: how many samples are still to be trained on.
    """
    array, size = field.memory.array, field.settings.feature_size
    variances, steps = array(field.features.variances), array(field.features.steps)
    rows = [
        field.tree.table(plane, h)[1]
        for plane in range(len(AXES))
        for h in range(field.settings.feature_levels)
    ]
    mlp = field.mlp[0::2] + field.mlp[1::2]
    return TrainingState(
        table_means=tuple(np.zeros((len(chosen), size), np.float32) for chosen in rows),
        table_variances=tuple(_rounded(variances[chosen]) for chosen in rows),
        table_steps=tuple(steps[chosen] for chosen in rows),
        mlp_means=tuple(array(part.means[0]).copy() for part in mlp),
        mlp_variances=tuple(array(part.variances[0]).copy() for part in mlp),
        mlp_steps=field.mlp_steps,
        sample_points=np.zeros((0, 3), np.float32),
        sample_labels=np.zeros(0, np.float16),
        budget_samples=budget_samples,
    )


def field_from_record(
    record: Region, settings: FieldSettings, memory: Memory, seed: int
) -> LiveField:
    """Return a field that answers as the recorded one and goes on training where it stopped."""
    layers = zip(record.mlp.weights, record.mlp.biases, strict=True)
    field = LiveField(
        settings,
        record.frequencies,
        [array for layer in layers for array in layer],
        # Without training state, it is unknown how much it learnt.
        mlp_steps=0 if record.training is None else record.training.mlp_steps,
        generator=np.random.default_rng(seed),
        memory=memory,
    )
    for table in record.tables:
        h = table.level - settings.levels[0]
        field.restore(table.plane, h, table.codes.astype(np.int64), features=table.vectors())
    if record.training is not None:
        _restore_optimiser(field, record.training)
    return field


def _restore_optimiser(field: LiveField, state: TrainingState) -> None:
    absent = np.zeros((1, field.settings.feature_size), np.float32)
    field.features.restore(
        np.concatenate([absent, *state.table_means]),
        np.concatenate([absent, *state.table_variances]),
        np.concatenate([np.zeros(1, np.int32), *state.table_steps]),
    )
    mlp = field.mlp[0::2] + field.mlp[1::2]
    taken = np.full(1, state.mlp_steps, np.int32)
    for part, mean, variance in zip(mlp, state.mlp_means, state.mlp_variances, strict=True):
        part.restore(mean[None], variance[None], taken)


def _rounded(values: Floats) -> Floats:
    """Return positive ``values`` to four significant bits; other bits are 0, and take no room."""
    dropped = 23 - _VARIANCE_BITS
    bits = values.view(np.int32) + (1 << dropped - 1)
    rounded: Floats = (bits >> dropped << dropped).view(np.float32)
    return rounded
