"""How far the thread that owns the map has come."""

import math
from dataclasses import dataclass

from triquad_format.wire.status_messages import FieldFit

from triquad_server.mapping.map_snapshot import MapFigures


@dataclass(frozen=True)
class Progress:
    """The work of the mapper's thread, as of its last slice."""

    settled: bool = True  # nothing is left to learn, and the newest epoch shows all
    own_samples_trained: int = 0  # by this process
    step_s: float = math.inf  # seconds that the last step of training took
    loss: float = 0.0  # as of the newest epoch
    fit: FieldFit | None = None  # of the newest epoch, to the rays that are held out
    map: MapFigures = MapFigures()
    waits_for_store: bool = False  # regions leave memory once the store has them
