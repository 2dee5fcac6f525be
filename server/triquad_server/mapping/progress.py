"""The progress of a map, in figures, and how well it fits its held-out rays."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from triquad_format.wire.messages import FieldFit
from triquad_map import field_fit

from triquad_server.mapping.live_region import LiveRegion


@dataclass(frozen=True)
class MapFigures:
    """The figures of a live map, by their names in the status."""

    scans_taken: int = 0  # also those before a restart
    samples_trained: int = 0  # also those before a restart
    samples_left: int = 0
    samples_discarded: int = 0  # so far, beyond the limit of what may be left
    rays_kept: int = 0  # to train on; one that crosses regions counts in each
    rays_discarded: int = 0  # so far, that were replaced by others, or were too many
    replay_share: float = 1.0  # kept, of the rays that each place is to keep
    map_bytes: int = 0  # bytes of the map and its newest epoch, without rays; an estimate


@dataclass(frozen=True)
class Progress:
    """The work of the mapper's thread, as of its last slice."""

    settled: bool = True  # nothing is left to learn, and the newest epoch shows all
    own_samples_trained: int = 0  # by this process
    step_s: float = math.inf  # seconds that the last step of training took
    loss: float = 0.0  # as of the newest epoch
    fit: FieldFit | None = None  # of the newest epoch, to the rays that are held out
    map: MapFigures = MapFigures()


def map_fit(regions: Iterable[LiveRegion]) -> FieldFit | None:
    """Return how well regions fit, as they were judged last; ``None`` where none was."""
    fits = [(region.centre, region.training.fit) for region in regions]
    return field_fit.map_fit([(centre, fit) for centre, fit in fits if fit is not None])
