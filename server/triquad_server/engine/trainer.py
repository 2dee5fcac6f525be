"""Trains a field: compiled code where it is in arrays, automatic differentiation elsewhere."""

from typing import Any, Protocol

from triquad_map.compiled.team import Team

from triquad_server.engine.compiled_trainer import CompiledTrainer
from triquad_server.engine.gradient_sums import GradientSums
from triquad_server.engine.live_field import Batch, LiveField, Rates
from triquad_server.engine.memory import ArrayMemory


class Loss(Protocol):
    """A number that a GPU may still be computing; reading it waits for that."""

    def __float__(self) -> float: ...
    def __add__(self, other: Any) -> Any: ...
    def __rmul__(self, factor: Any) -> Any: ...


class Trainer(Protocol):
    """Trains a field."""

    def train(self, batch: Batch, rates: Rates) -> Loss:
        """Take one optimiser step; return the loss before it."""


def trainer_of(field: LiveField, sums: GradientSums, team: Team) -> Trainer:
    """Return the trainer of a field; ``sums`` and ``team`` are for compiled code."""
    if isinstance(field.memory, ArrayMemory):
        return CompiledTrainer(field, sums, team)
    from triquad_server.engine.tensor_trainer import TensorTrainer

    return TensorTrainer(field)
