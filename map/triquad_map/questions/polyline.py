"""What a ball meets that moves along a polyline."""

from dataclasses import dataclass

import numpy as np

from triquad_map.questions.segments import Segments
from triquad_map.unknown import Unknown, UnknownSpaceError


@dataclass(frozen=True)
class Polyline:
    """As :class:`Segments`, of several one after the other; places are metres from the start."""

    length_m: float
    blocked: bool
    contact_m: float
    clearance_m: float
    clearance_at_m: float
    meets_unknown: bool
    unknown_contact_m: float
    epoch: int

    def free(self, unknown: Unknown | str = Unknown.OBSTACLE) -> bool:
        """Whether the ball can pass, where unknown space counts as asked.

        Raises:
            UnknownSpaceError: it counts as an error, and is met before any contact.
            ValueError: ``unknown`` is no :class:`Unknown`.
        """
        if Unknown(unknown) is Unknown.ERROR and self.meets_unknown:
            raise UnknownSpaceError("polyline", 0, 1)
        return not self.blocked and (Unknown(unknown) is Unknown.FREE or not self.meets_unknown)


def along_polyline(parts: Segments) -> Polyline:
    """Consecutive segments as one way."""
    lengths = parts.length_m.astype(np.float64)
    begins = np.cumsum(lengths) - lengths
    total = float(lengths.sum())
    # Nothing behind the first contact is reached.
    last = int(parts.blocked.argmax()) if parts.blocked.any() else len(lengths) - 1
    narrowest = int(parts.clearance_m[: last + 1].argmin())
    unknown = parts.meets_unknown[: last + 1]
    first_unknown = int(unknown.argmax())
    return Polyline(
        length_m=total,
        blocked=bool(parts.blocked[last]),
        contact_m=float(begins[last] + parts.contact_m[last]) if parts.blocked[last] else total,
        clearance_m=float(parts.clearance_m[narrowest]),
        clearance_at_m=float(begins[narrowest] + parts.clearance_at_m[narrowest]),
        meets_unknown=bool(unknown.any()),
        unknown_contact_m=float(begins[first_unknown] + parts.unknown_contact_m[first_unknown])
        if unknown.any()
        else total,
        epoch=parts.epoch,
    )
