"""A z-buffer: which triangle is nearest in each pixel. Compiled, no display and no GPU."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.arrays import Doubles, Floats, Ints
from triquad_map.compiled.kernel import kernel


@dataclass(frozen=True)
class Raster:
    """What each pixel shows; row 0 is the top of the picture."""

    nearness: Doubles  # [H, W] greater is nearer; minus infinity where nothing is
    faces: Ints  # [H, W] rows of faces; -1 where nothing is
    weights: Floats  # [H, W, 3] of the face's corners, linear in the picture


def rasterise(corners: Doubles, faces: NDArray[np.integer], width: int, height: int) -> Raster:
    """Draw triangles into a z-buffer.

    Args:
        corners: ``[V, 3]`` of vertices in the picture: column, row, and a nearness that is linear
            in the picture (the inverse depth, in perspective). Faces with a vertex that is not
            finite are left out.
        faces: ``[F, 3]`` rows of ``corners``.
        width: of the picture, pixels.
        height: of the picture, pixels.
    """
    raster = Raster(
        nearness=np.full((height, width), -np.inf),
        faces=np.full((height, width), -1, np.int32),
        weights=np.zeros((height, width, 3), np.float32),
    )
    rows = np.ascontiguousarray(faces, np.int32)
    _draw(corners, rows, raster.nearness, raster.faces, raster.weights)
    return raster


@kernel()
def _draw(corners: Doubles, faces: Ints, nearness: Doubles, owners: Ints, weights: Floats) -> None:
    height, width = nearness.shape
    for f in range(faces.shape[0]):
        ax, ay, an = corners[faces[f, 0]]
        bx, by, bn = corners[faces[f, 1]]
        cx, cy, cn = corners[faces[f, 2]]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not np.isfinite(area) or area == 0.0:
            continue
        left = int(max(np.ceil(min(ax, bx, cx) - 0.5), 0.0))
        right = int(min(np.floor(max(ax, bx, cx) - 0.5), width - 1.0))
        top = int(max(np.ceil(min(ay, by, cy) - 0.5), 0.0))
        bottom = int(min(np.floor(max(ay, by, cy) - 0.5), height - 1.0))
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                near = wa * an + wb * bn + wc * cn
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    owners[row, column] = f
                    weights[row, column, 0] = wa
                    weights[row, column, 1] = wb
                    weights[row, column, 2] = wc
