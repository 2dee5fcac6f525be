"""The field of a region in voxels, to which surfels are fitted."""

import numpy as np
from triquad_format.records.arrays import Doubles
from triquad_format.records.field_settings import FieldSettings

from triquad_map.composition.region import FieldEngine
from triquad_map.composition.split import Split
from triquad_map.surface.surfels import FieldSample, SampleField


def field_samples(engine: FieldEngine, settings: FieldSettings, split: Split) -> SampleField:
    """The field of a region in voxels, at its leaf coordinates."""
    middle = 1 << (settings.depth - 1)

    def sample(voxels: Doubles) -> FieldSample:
        local = ((voxels - middle) * settings.leaf_m).astype(np.float32)
        values = np.empty(len(local), np.float32)
        gradients = np.empty((len(local), 3), np.float32)

        def work(first: int, last: int) -> None:
            part = engine.evaluate(local[first:last], True)
            values[first:last] = part.sdf / settings.leaf_m
            gradients[first:last] = part.gradient

        split(len(local), work)
        return FieldSample(values, gradients)

    return sample
