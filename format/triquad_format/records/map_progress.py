"""The training progress of a map. It goes on with the map, whichever process goes on with it."""

import math
from dataclasses import dataclass

from triquad_format.errors import FormatError

_MOST = 2**62


@dataclass(frozen=True)
class MapProgress:
    """The progress of a map."""

    scans_taken: int = 0
    samples_trained: int = 0
    loss: float = 0.0  # recent training loss; 0 before any training

    def check(self) -> None:
        """Raise :class:`FormatError`, naming the field, unless the numbers are possible."""
        for name in ("scans_taken", "samples_trained"):
            if not 0 <= getattr(self, name) < _MOST:
                raise FormatError(f"{name} = {getattr(self, name)} is not a count below 2**62")
        if not (math.isfinite(self.loss) and self.loss >= 0):
            raise FormatError(f"loss = {self.loss} is not a loss: use a finite number from 0 on")
