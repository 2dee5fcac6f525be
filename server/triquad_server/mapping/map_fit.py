"""How well the whole map fits its held-out rays, as the status tells it."""

from collections.abc import Sequence

import numpy as np
from triquad_format.wire.messages import FieldFit

from triquad_server.mapping.live_region import LiveRegion

_WORST = 5  # places that are told
_LEAST_RAYS = 24  # of such a place
_UPPER = 0.9


def map_fit(regions: Sequence[LiveRegion]) -> FieldFit | None:
    """How regions fit, as they were judged last; ``None`` where none was."""
    judged = [(region, region.places) for region in regions if region.places is not None]
    if not judged:
        return None
    errors_m = np.concatenate([places.errors_m for _, places in judged])
    centres = np.concatenate([places.centres + region.centre for region, places in judged])
    medians_m = np.concatenate([places.medians_m for _, places in judged])
    rays = np.concatenate([places.rays for _, places in judged])
    enough = np.flatnonzero(rays >= _LEAST_RAYS)
    worst = enough[np.argsort(-medians_m[enough], kind="stable")[:_WORST]]
    return FieldFit(
        rays=len(errors_m),
        median_m=float(np.median(errors_m)),
        upper_m=float(np.quantile(errors_m, _UPPER)),
        worst=centres[worst],
        worst_median_m=medians_m[worst].astype(np.float32),
        repairing=sum(int(places.forgotten.sum()) for _, places in judged),
        repaired=sum(region.repairs.done for region in regions),
        given_up=sum(region.repairs.given_up for region in regions),
    )
