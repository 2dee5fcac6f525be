"""How far a map has come, in figures."""

from dataclasses import dataclass

from triquad_format.wire.messages import FieldFit


@dataclass(frozen=True)
class MapFigures:
    """The figures of a live map."""

    scans_taken: int = 0  # also those before a restart
    samples_trained: int = 0  # likewise
    samples_left: int = 0
    samples_discarded: int = 0  # so far, which were more than may be left
    rays_kept: int = 0  # to train on; one that crosses regions counts in each
    rays_discarded: int = 0  # so far, that gave way to others, or were too many
    replay_share: float = 1.0  # of the rays that each place is to keep
    map_bytes: int = 0  # that the map and its newest epoch take, without rays; an estimate
    normals_bytes: int = 0  # that moments of points take, for normals of coming scans


@dataclass(frozen=True)
class Progress:
    """What the mapper's thread has done, as of its last slice."""

    settled: bool = True  # nothing is left to learn, and the newest epoch shows all
    own_samples_trained: int = 0  # by this process
    loss: float = 0.0  # as of the newest epoch
    fit: FieldFit | None = None  # of the newest epoch, to the rays that are held out
    map: MapFigures = MapFigures()
