"""The functions that are called when a map changes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from triquad_format.wire.messages import Scan

from triquad_server.epochs.epoch import Epoch
from triquad_server.intake.rays import ScanRays


@dataclass(frozen=True)
class MapListeners:
    """Functions that the mapper's thread calls; they are quick, and raise nothing."""

    scan_taken: Sequence[Callable[[Scan, ScanRays], None]] = ()  # with what of it is used
    published: Sequence[Callable[[Epoch], None]] = ()  # before others can see the epoch
