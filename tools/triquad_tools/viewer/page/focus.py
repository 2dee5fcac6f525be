"""What somebody looks at, and how much around it is in view."""

import math
from dataclasses import dataclass

import numpy as np
from triquad_format.records.arrays import Doubles

from triquad_tools.viewer.page.page import Page

_LEAST_SIDE_M, _MOST_SIDE_M = 2.0, 128.0


@dataclass(frozen=True)
class Focus:
    """The middle of a view."""

    middle: Doubles  # [3] metres, map frame
    distance_m: float  # of the eye
    side_m: float  # about what is in view at that distance: a power of two, 2 to 128 m

    def snapped(self, step_m: float) -> Doubles:
        """The middle [3], to whole steps: somewhere else only once the view has moved so far."""
        return np.asarray(np.round(self.middle / step_m) * step_m, np.float64)


def focus_of(page: Page) -> Focus:
    """What the camera of a page is turned about."""
    camera = page.client.camera
    distance_m = float(np.linalg.norm(camera.look_at - camera.position))
    aspect = camera.image_width / max(camera.image_height, 1)
    seen_m = 2.0 * distance_m * math.tan(0.5 * camera.fov) * max(aspect, 1.0)
    side_m = 2.0 ** round(math.log2(max(seen_m, _LEAST_SIDE_M)))
    return Focus(page.in_map(camera.look_at), distance_m, min(side_m, _MOST_SIDE_M))
