"""Measures how well the whole map fits its held-out rays, for the status."""

from collections.abc import Iterable

import numpy as np
from triquad_format.wire.messages import FieldFit
from triquad_map import field_fit

from triquad_server.mapping.live_region import LiveRegion


def map_fit(regions: Iterable[LiveRegion]) -> FieldFit | None:
    """Return how well regions fit, as they were judged last; ``None`` where none was."""
    judgements = [(region.centre, region.training.judgement) for region in regions]
    judged = [(centre, judgement.fit) for centre, judgement in judgements if judgement.fit]
    fit = field_fit.map_fit(judged)
    if fit is None:
        return None
    return FieldFit(
        rays=fit.rays,
        median_m=fit.median_m,
        upper_m=fit.upper_m,
        worst=fit.worst,
        worst_median_m=fit.worst_median_m.astype(np.float32),
        repairing=sum(int(places.forgotten.sum()) for _, places in judged),
        repaired=sum(judgement.repairs.done for _, judgement in judgements),
        given_up=sum(judgement.repairs.given_up for _, judgement in judgements),
    )
