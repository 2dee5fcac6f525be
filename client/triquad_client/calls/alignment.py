"""Where a scan was taken."""

import numpy as np
from numpy.typing import ArrayLike
from triquad_format.wire import keys
from triquad_format.wire.query_messages import AlignReply, AlignRequest
from triquad_map.questions.align import FINE_POINTS, Alignment, AlignOptions
from triquad_map.questions.thinning import thinned

from triquad_client import checks
from triquad_client.net.call import Ask, Call, ask, offload
from triquad_client.net.parts import NEWEST


def query(
    points: ArrayLike,
    guess: ArrayLike,
    options: AlignOptions,
    at_epoch: int | None,
) -> Call[Alignment]:
    """The pose of ``points`` [N, 3] of the sensor frame, near a guess [4, 4]."""
    epoch = checks.chosen_epoch(at_epoch)
    cloud = checks.scan_points(points)
    # Here, not only where it is answered: a hundredth of a scan travels.
    few = yield from offload(lambda _: thinned(cloud.astype(np.float64), FINE_POINTS))
    request = AlignRequest(
        points=few.astype(np.float32),
        world_from_sensor=checks.rigid_pose(guess),
        max_distance_m=checks.within("max_distance_m", options.max_distance_m),
        max_iterations=options.max_iterations,
        epoch=NEWEST if epoch is None else epoch,
    )
    reply = yield from ask(Ask(keys.ALIGN, request, AlignReply))
    return Alignment(
        world_from_sensor=reply.world_from_sensor,
        covariance=reply.covariance,
        inlier_share=reply.inlier_share,
        rms_m=reply.rms_m,
        converged=reply.converged,
        iterations=reply.iterations,
        points=reply.points,
        epoch=reply.epoch,
    )
