"""What trains a field: compiled code where it is on the CPU, tensors elsewhere."""

from typing import Protocol

from torch import Tensor
from triquad_map.compiled.team import Team

from triquad_server.engine.adam import Rates
from triquad_server.engine.batch import Batch
from triquad_server.engine.compiled_trainer import CompiledTrainer, GradientSums
from triquad_server.engine.live_field import LiveField
from triquad_server.engine.tensor_trainer import TensorTrainer

Loss = float | Tensor
"""A number, or a tensor that holds it on a device: whoever reads it there waits for the device."""


class Trainer(Protocol):
    """Trains one field."""

    def train(self, batch: Batch, rates: Rates) -> Loss:
        """One optimiser step; returns the loss before it."""


def make_trainer(field: LiveField, sums: GradientSums, team: Team) -> Trainer:
    """The trainer for the device on which a field is; the last two serve the CPU."""
    if field.device.type == "cpu":
        return CompiledTrainer(field, sums, team)
    return TensorTrainer(field)
