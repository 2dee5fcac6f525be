"""Trains the MLP that regions begin with, on simulated streets: ``make pretrained``.

The streets are none of those that benchmarks and tests drive along by default.
"""

import os
from collections.abc import Sequence

import numpy as np
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings
from triquad_server.engine.initial_mlp import PRETRAINED, random_mlp
from triquad_server.engine.live_field import LiveField
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings
from triquad_server.warm_up import warm_up
from triquad_tools.console.progress import progress

from bench.street import bench_street, learn_all

_STREETS = range(1000, 1004)


def main() -> None:
    """Learn one street after another, each with new features and the MLP of the one before."""
    field = Settings().field
    mlp: Sequence[Floats] = random_mlp(field, np.random.default_rng(0))
    with progress("learning streets", len(_STREETS)) as report:
        for number, seed in enumerate(_STREETS):
            report(number, f"street {seed}")
            mlp = _learnt_on(seed, mlp)
    _write(mlp, field)


def _learnt_on(street: int, mlp: Sequence[Floats]) -> Sequence[Floats]:
    """Return an ``mlp`` after learning a street as if it were new."""
    settings = Settings()
    warm_up(settings, "cpu")
    mapper = Mapper("pretraining", settings, "cpu")
    for scan in bench_street(street).scans:
        mapper.ingest(scan.points, scan.world_from_sensor)
    (region,) = mapper.regions
    _begin_with(mlp, region.field)
    learn_all(mapper)
    return [part.copy() for part in region.field.arrays.mlp]


def _begin_with(mlp: Sequence[Floats], field: LiveField) -> None:
    """Begin with an MLP, but without its weights of Fourier features, which know a place."""
    field.mlp_steps = 0
    for part, values in zip(field.mlp, mlp, strict=True):
        part.values[0] = values
        part.steps[:] = 0
    field.mlp[0].values[0, _features(field.settings) :] = 0


def _write(mlp: Sequence[Floats], field: FieldSettings) -> None:
    """Have regions begin with the ``mlp`` of a field of these settings."""
    weights1, bias1, weights2, bias2, *last = mlp
    of_features = weights1[: _features(field)]
    leaves_per_logit = np.float32(field.logit_scale_m / field.leaf_m)
    weights3, bias3 = (part * leaves_per_logit for part in last)
    written = PRETRAINED.with_name("pretrained_mlp.new.npz")
    np.savez(
        written,
        weights1=of_features.reshape(field.feature_levels, field.feature_size, field.hidden),
        bias1=bias1,
        weights2=weights2,
        bias2=bias2,
        weights3=weights3,
        bias3=bias3,
        feature_std=field.feature_std,
    )
    os.replace(written, PRETRAINED)


def _features(field: FieldSettings) -> int:
    """Return how many inputs of the MLP are features."""
    return field.feature_levels * field.feature_size


if __name__ == "__main__":
    main()
