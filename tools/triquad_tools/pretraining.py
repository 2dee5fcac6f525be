"""Trains the MLP that regions begin with, on simulated streets: ``make pretrained``.

The streets are none of those that benchmarks and tests drive along by default.
"""

import torch
from triquad_server.engine.initial_mlp import random_mlp, write_pretrained
from triquad_server.settings import Settings

from triquad_tools.benchmarks.street import bench_street, settled_mapper

_STREETS = range(1000, 1004)


def main() -> None:
    """Learn one street after another, each with new features and the MLP of the one before."""
    field = Settings().field
    start = random_mlp(field, torch.Generator().manual_seed(0))
    write_pretrained([part.numpy() for part in start], field)
    for seed in _STREETS:
        mapper = settled_mapper(f"street {seed}", bench_street(seed).scans)
        (region,) = mapper.regions
        write_pretrained(region.field.arrays.mlp, field)


if __name__ == "__main__":
    main()
