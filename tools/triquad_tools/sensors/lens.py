"""Cameras whose images are not rectified: the ray of each pixel, free of the lens's distortion."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from triquad_client.depth_image import Intrinsics
from triquad_format.records.arrays import Doubles

from triquad_tools.sensors.sweep import NoScanError

_ITERATIONS = 10
_MAX_ANGLE_RAD, _SAMPLES = 1.5, 30_000  # of rays from the optical axis


@dataclass(frozen=True, eq=False)
class LensCamera(Intrinsics):
    """A camera with a table of its rays."""

    table: Doubles  # [2, rows, columns] x and y per metre; NaN where the lens has no ray
    model: str

    def slopes(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Doubles:
        """Return x and y per metre of depth [2, N] of pixels [N]; NaN where there is no ray."""
        return self.table[:, rows, columns]

    @property
    def note(self) -> str:
        """What is done, for a user."""
        blind = np.isnan(self.table[0]).mean()
        none = f", no ray for {blind:.0%} of the pixels" if blind >= 0.005 else ""
        return f"lens distortion {self.model} taken out{none}"


@lru_cache(maxsize=16)
def lens_camera(
    camera: Intrinsics, model: str, values: tuple[float, ...], rows: int, columns: int
) -> LensCamera:
    """Return the camera of a ``CameraInfo`` with distortion, by the models of OpenCV.

    Raises:
        NoScanError: the model is none of those that are understood.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*values, *(0.0,) * 8)[:8]
    angle = np.linspace(0.0, _MAX_ANGLE_RAD, _SAMPLES)
    radius = np.tan(angle)
    if model in ("plumb_bob", "rational_polynomial") and not any(values[8:]):
        r2 = radius**2
        scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        distorted = radius * scale
    elif model in ("equidistant", "fisheye"):
        a2 = angle**2
        distorted = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (p1 + a2 * p2))))
        p1 = p2 = 0.0
    else:
        raise NoScanError(
            "intrinsics",
            f"the lens distortion {model!r} of {len(values)} numbers is not understood: use the "
            "rectified image (image_rect, by image_proc)",
        )
    # Beyond the first radius at which the polynomial falls, there are no rays.
    end = int(np.argmin(np.append(np.diff(distorted) > 0, False))) + 1

    def straight(x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
        length = np.hypot(x, y)
        found = np.interp(length, distorted[:end], radius[:end], right=np.nan)
        factor = np.divide(found, length, out=np.ones_like(found), where=length > 0)
        return x * factor, y * factor

    v, u = np.mgrid[:rows, :columns].astype(np.float64)
    seen_x, seen_y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    x, y = straight(seen_x, seen_y)
    for _ in range(_ITERATIONS):  # as OpenCV's undistortPoints
        r2 = x**2 + y**2
        aside_x = 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        aside_y = 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
        x, y = straight(seen_x - aside_x, seen_y - aside_y)
    return LensCamera(camera.fx, camera.fy, camera.cx, camera.cy, np.stack([x, y]), model)
