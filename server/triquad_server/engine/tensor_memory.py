"""Keeps fields in tensors, on any device: the memory of the reference engine."""

import torch
from torch import Tensor
from triquad_format.records.field_settings import FieldSettings
from triquad_map.compiled.field.quadtree import FrozenQuadtree

from triquad_server.engine.memory import Array, FieldNumbers
from triquad_server.engine.tensor_field import FieldTensors, TensorField


class TensorMemory:
    """Keeps numbers in tensors on one device."""

    def __init__(self, device: str) -> None:
        self.device = device

    def put(self, array: Array) -> Tensor:
        """Return a copy of an array."""
        return torch.tensor(array, device=self.device)

    def room(self, count: int, like: Tensor) -> Tensor:
        """Return ``count`` rows shaped as those of ``like``, not initialised."""
        return like.new_empty((count, *like.shape[1:]))

    def array(self, rows: Tensor) -> Array:
        """Return rows as an array; from another device, a copy, for which all work there ends."""
        array: Array = rows.cpu().numpy()
        return array

    def field(
        self, settings: FieldSettings, tree: FrozenQuadtree, numbers: FieldNumbers
    ) -> TensorField:
        """Return the field in tensors."""
        return TensorField(settings, tree, FieldTensors(*numbers))
