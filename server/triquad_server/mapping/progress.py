"""The progress of a map, in figures."""

from dataclasses import dataclass

from triquad_format.wire.messages import FieldFit


@dataclass(frozen=True)
class MapFigures:
    """The figures of a live map."""

    scans_taken: int = 0  # also those before a restart
    samples_trained: int = 0  # also those before a restart
    samples_left: int = 0
    samples_discarded: int = 0  # so far, beyond the limit of what may be left
    rays_kept: int = 0  # to train on; one that crosses regions counts in each
    rays_discarded: int = 0  # so far, that were replaced by others, or were too many
    replay_share: float = 1.0  # kept, of the rays that each place is to keep
    map_bytes: int = 0  # bytes of the map and its newest epoch, without rays; an estimate
    normals_bytes: int = 0  # bytes of the moments of points, for normals of coming scans


@dataclass(frozen=True)
class Progress:
    """The work of the mapper's thread, as of its last slice."""

    settled: bool = True  # nothing is left to learn, and the newest epoch shows all
    own_samples_trained: int = 0  # by this process
    loss: float = 0.0  # as of the newest epoch
    fit: FieldFit | None = None  # of the newest epoch, to the rays that are held out
    map: MapFigures = MapFigures()
