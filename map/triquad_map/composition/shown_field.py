"""The field of a region as a map shows it, also before it has learnt what rays have shown."""

from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Floats, Longs

from triquad_map.field.frozen_field import FieldValues, FrozenField, in_grid
from triquad_map.surfels.surfel_map import SurfelMap


@dataclass(frozen=True)
class ShownField:
    """A trained field, and near surface that it has not learnt, the planes that rays have shown."""

    trained: FrozenField
    surfels: SurfelMap

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """Return the field at points [N, 3], on the caller's thread."""
        values = self.trained.evaluate(points, gradient)
        self.surfels.put_planes(self.trained.settings, points, values.sdf, values.gradient)
        return values

    def evaluate_in_grid(self, axes: Floats, points: Longs) -> Floats:
        """Return distances [N] at points of a grid: :meth:`FrozenField.evaluate_in_grid`."""
        distances = self.trained.evaluate_in_grid(axes, points)
        if not self.surfels.are_learnt:
            places, gradients = in_grid(axes, points), np.zeros((0, 3), np.float32)
            self.surfels.put_planes(self.trained.settings, places, distances, gradients)
        return distances
