"""From the arrays of a field to its compiled form, and from points to its values."""

from collections.abc import Sequence

import numpy as np
from triquad_format.records.arrays import Floats
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Region

from triquad_map.compiled.field import field as compiled_field
from triquad_map.compiled.field.encoding import Geometry
from triquad_map.compiled.field.field import CompiledField
from triquad_map.compiled.field.mlp import Mlp
from triquad_map.compiled.field.quadtree import FrozenQuadtree, LiveQuadtree
from triquad_map.composition.region import FieldValues


class FrozenField:
    """The field of a region that does not change, in compiled code. For any thread."""

    def __init__(self, settings: FieldSettings, field: CompiledField) -> None:
        self._settings = settings
        self._field = field

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre; on the caller's thread."""
        return field_values(self._field, self._settings, points, gradient)

    @classmethod
    def from_record(cls, settings: FieldSettings, region: Region) -> "FrozenField":
        """The field of a region as a file holds it."""
        tree = LiveQuadtree(settings)
        features = [np.zeros((1, settings.feature_size), np.float32)]  # row 0: absent vertices
        for table in region.tables:
            h = table.level - settings.levels.start
            tree.restore(table.plane, h, table.codes.astype(np.int64))
            features.append(table.vectors())
        layers = zip(region.mlp.weights, region.mlp.biases, strict=True)
        mlp = [np.ascontiguousarray(array, np.float32) for layer in layers for array in layer]
        frequencies = np.asarray(region.frequencies, np.float32)
        return cls(settings, make_field(settings, tree, np.concatenate(features), mlp, frequencies))


def make_field(
    settings: FieldSettings,
    tree: LiveQuadtree | FrozenQuadtree,
    features: Floats,
    mlp: Sequence[Floats],
    frequencies: Floats,
) -> CompiledField:
    """The compiled form of a field; it shares memory with the arrays.

    Args:
        settings: of the field.
        tree: its vertices.
        features: [rows, feature_size] by the tree's rows; row 0 is zero.
        mlp: weights and bias of each layer in turn.
        frequencies: [m] Fourier frequencies, on coordinates normalised to [-1, 1].
    """
    geometry = Geometry(
        np.float32(settings.leaf_m),
        np.float32(1 << (settings.depth - 1)),
        settings.feature_levels if settings.encoding != "fourier" else 0,
        tree.shape,
    )
    w1, b1, w2, b2, w3, b3 = mlp
    turns = frequencies / np.float32(settings.region_side_m / 2)
    return CompiledField(
        geometry,
        tree.vertices,
        features,
        Mlp(w1, b1, w2, b2, w3.reshape(-1), b3),
        turns if settings.encoding != "features" else turns[:0],
    )


def field_values(
    field: CompiledField, settings: FieldSettings, points: Floats, gradient: bool
) -> FieldValues:
    """The field at points [N, 3], metres from the region's centre; on the caller's thread."""
    logits = np.empty(len(points), np.float32)
    gradients = np.empty((len(points) if gradient else 0, 3), np.float32)
    compiled_field.evaluate(points, field, logits, gradients)
    scale = np.float32(settings.logit_scale_m)
    return FieldValues(logits * scale, gradients * scale)
