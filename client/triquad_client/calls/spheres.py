"""Whether spheres are free."""

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.wire import keys
from triquad_format.wire.query_messages import SpheresReply, SpheresRequest
from triquad_map.questions.spheres import Spheres

from triquad_client import checks
from triquad_client.calls.distance import PART_POINTS
from triquad_client.net.call import Ask, Call
from triquad_client.net.parts import in_parts, relative


def query(centres: ArrayLike, radii_m: ArrayLike, at_epoch: int | None) -> Call[Spheres]:
    """What spheres around ``centres`` [N, 3] hold; ``radii_m`` are one number or [N]."""
    checked = checks.query_points(centres)
    sizes = checks.radii(radii_m, len(checked))

    def request(part: slice, number: int) -> Ask[SpheresReply]:
        sent = relative(checked[part])
        message = SpheresRequest(
            origin=sent.origin, centres=sent.offsets, radii_m=sizes[part], epoch=number
        )
        return Ask(keys.SPHERES, message, SpheresReply)

    epoch = checks.chosen_epoch(at_epoch)
    parts = yield from in_parts(len(checked), PART_POINTS, request, epoch)
    return Spheres(np.concatenate([part.status for part in parts]), parts[0].epoch)
