"""Things thinner than a voxel, which stand."""

import numpy as np
from triquad_tools.simulation.solids import Solid, box, cylinder


def thin_things(x: float, y: float, length_m: float = 12.0) -> list[Solid]:
    """Return posts of 2 cm, two wires of 4 cm and a fence of bars of 16 mm.

    They stand along x for ``length_m`` from ``x`` on, within 1.2 m of ``y``, metres.
    """
    solids = [cylinder((x + i, y, 0.5), 0.01, 0.7) for i in np.arange(0.0, length_m, 2.0)]
    middle = x + 0.5 * length_m
    solids.append(box((middle, y - 0.6, 1.4), (0.5 * length_m, 0.02, 0.02), 0.0, 0.02))
    solids.append(box((middle, y + 0.6, 2.6), (0.5 * length_m, 0.02, 0.02), 0.0, 0.02))
    bars = np.arange(0.0, length_m, 0.12)
    solids += [cylinder((x + i, y + 1.2, 0.5), 0.008, 0.6) for i in bars]
    return solids
