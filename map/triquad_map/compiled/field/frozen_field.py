"""The field of a region that does not change any more, in compiled code."""

from typing import NamedTuple

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


class FieldArrays(NamedTuple):
    """The numbers of a field."""

    features: (
        Floats  # [rows, feature_size] by the rows of its tree; row 0, absent vertices, is zero
    )
    mlp: tuple[Floats, ...]  # weights [in, out] and bias [out] of each layer in turn
    frequencies: Floats  # [m] of Fourier features, on coordinates normalised to [-1, 1]


class FrozenCompiledField:
    """A field that answers from arrays, which nothing may change from then on."""

    def __init__(self, settings: FieldSettings, tree: FrozenQuadtree, arrays: FieldArrays) -> None:
        self.settings = settings
        self.tree = tree
        self.arrays = arrays
        self._field = make_field(settings, tree, arrays)

    def evaluate(self, points: Floats, gradient: bool) -> FieldValues:
        """The field at points [N, 3], metres from the region's centre; on the caller's thread."""
        logits = np.empty(len(points), np.float32)
        gradients = np.empty((len(points) if gradient else 0, 3), np.float32)
        compiled_field.evaluate(points, self._field, logits, gradients)
        scale = np.float32(self.settings.logit_scale_m)
        return FieldValues(logits * scale, gradients * scale)


def recorded_field(settings: FieldSettings, region: Region) -> FrozenCompiledField:
    """The field of a region as a file holds it."""
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
    return FrozenCompiledField(settings, tree.freeze(), arrays)


def make_field(
    settings: FieldSettings, tree: LiveQuadtree | FrozenQuadtree, arrays: FieldArrays
) -> CompiledField:
    """The form of a field that kernels take; it shares memory with the arrays and the tree."""
    geometry = Geometry(
        np.float32(settings.leaf_m),
        np.float32(1 << (settings.depth - 1)),
        settings.feature_levels if settings.encoding != "fourier" else 0,
        tree.shape,
    )
    w1, b1, w2, b2, w3, b3 = arrays.mlp
    turns = arrays.frequencies / np.float32(settings.region_side_m / 2)
    return CompiledField(
        geometry,
        tree.vertices,
        arrays.features,
        Mlp(w1, b1, w2, b2, w3.reshape(-1), b3),
        turns if settings.encoding != "features" else turns[:0],
    )
