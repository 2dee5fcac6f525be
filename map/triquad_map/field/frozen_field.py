"""A field that answers from arrays which do not change, such as those of an epoch or of a file."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Region

from triquad_map.compiled.team import Split
from triquad_map.field.field import FieldArrays, evaluate, make_field
from triquad_map.field.grid import evaluate_in_grid
from triquad_map.field.quadtree import FrozenQuadtree, LiveQuadtree
from triquad_map.surface import FieldSample, SampleField

_Float = TypeVar("_Float", np.float32, np.float64)


@dataclass(frozen=True)
class FieldValues:
    """Signed distances [N] and, where asked for, their gradients [N, 3] (else [0, 3])."""

    sdf: Floats
    gradient: Floats


class FrozenField:
    """A field that answers from arrays, which nothing may change from then on."""

    def __init__(self, settings: FieldSettings, tree: FrozenQuadtree, arrays: FieldArrays) -> None:
        self.settings = settings
        self.tree = tree
        self.arrays = arrays
        self._field = make_field(settings, tree, arrays)

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """Return the field at points [N, 3], metres from the centre; on the caller's thread."""
        logits = np.empty(len(points), np.float32)
        gradients = np.empty((len(points) if gradient else 0, 3), np.float32)
        evaluate(points, self._field, logits, gradients)
        scale = np.float32(self.settings.logit_scale_m)
        return FieldValues(logits * scale, gradients * scale)

    def evaluate_in_grid(self, axes: Floats, points: Longs) -> Floats:
        """Return distances [N] at ``points`` [N, 3] of a grid, by their numbers on its ``axes``.

        ``axes`` [3, S] are metres from the region's centre. Those of a point do not depend on which
        others are asked for. On the caller's thread.
        """
        logits = np.empty(len(points), np.float32)
        evaluate_in_grid(axes, points, self._field, logits)
        distances: Floats = logits * np.float32(self.settings.logit_scale_m)
        return distances


def in_grid(axes: NDArray[_Float], points: Longs) -> NDArray[_Float]:
    """Return points [N, 3] of a grid with coordinates ``axes`` [3, S], by their numbers there."""
    places = [axis[numbers] for axis, numbers in zip(axes, points.T, strict=True)]
    return np.stack(places, axis=1)


def recorded_field(settings: FieldSettings, region: Region) -> FrozenField:
    """Return the field of a region as a file has it."""
    tree = LiveQuadtree(settings)
    features = [np.zeros((1, settings.feature_size), np.float32)]  # row 0: absent vertices
    for table in region.tables:
        h = table.level - settings.levels.start
        tree.restore(table.plane, h, table.codes.astype(np.int64))
        features.append(table.vectors())
    layers = zip(region.mlp.weights, region.mlp.biases, strict=True)
    arrays = FieldArrays(
        np.concatenate(features),
        tuple(np.ascontiguousarray(array, np.float32) for layer in layers for array in layer),
        np.asarray(region.frequencies, np.float32),
    )
    return FrozenField(settings, tree.freeze(), arrays)


def field_samples(engine: FrozenField, settings: FieldSettings, split: Split) -> SampleField:
    """Return the field of a region in voxels, at its leaf coordinates."""

    def sample(voxels: Doubles) -> FieldSample:
        local = settings.offsets(voxels).astype(np.float32)
        values = np.empty(len(local), np.float32)
        gradients = np.empty((len(local), 3), np.float32)

        def work(first: int, last: int) -> None:
            part = engine.evaluate(local[first:last], True)
            values[first:last] = part.sdf / settings.leaf_m
            gradients[first:last] = part.gradient

        split(len(local), work)
        return FieldSample(values, gradients)

    return sample
