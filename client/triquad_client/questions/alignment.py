"""Where a scan was taken."""

from numpy.typing import ArrayLike
from triquad_format import keys
from triquad_format.query_messages import AlignReply, AlignRequest
from triquad_query.align import Alignment, AlignOptions

from triquad_client import checks
from triquad_client.call import Ask, Call, ask
from triquad_client.parts import NEWEST


def query(
    points: ArrayLike,
    guess: ArrayLike,
    options: AlignOptions,
    at_epoch: int | None,
) -> Call[Alignment]:
    """The pose of ``points`` [N, 3] of the sensor frame, near a guess [4, 4]."""
    epoch = checks.chosen_epoch(at_epoch)
    request = AlignRequest(
        checks.scan_points(points),
        checks.rigid_pose(guess),
        checks.positive("max_distance", options.max_distance_m),
        options.max_iterations,
        NEWEST if epoch is None else epoch,
    )
    reply = yield from ask(Ask(keys.ALIGN, request, AlignReply))
    return Alignment(
        reply.world_from_sensor,
        reply.covariance,
        reply.inlier_share,
        reply.rms_m,
        reply.converged,
        reply.iterations,
        reply.points,
        reply.epoch,
    )
