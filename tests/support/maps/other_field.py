"""A map with the evidence of a record, and any field."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.region import MapRecord
from triquad_map.composition.recorded_view import RecordedView
from triquad_map.field.frozen_field import in_grid

Sdf = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Signed distances [N] at points [N, 3], metres, map frame."""


class OtherField(RecordedView):
    """Meshes of it show the surface of ``sdf`` where rays of the record ended."""

    def __init__(self, record: MapRecord, sdf: Sdf) -> None:
        super().__init__(record)
        self._sdf = sdf

    def distances_in_grid(
        self, axes: NDArray[np.float64], points: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        return self._sdf(in_grid(axes, points)).astype(np.float32)
