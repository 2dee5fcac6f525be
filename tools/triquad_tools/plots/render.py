"""Pictures of meshes: shaded in software, with a sun, its shadows and a soft sky.

Own code, as the libraries that do this want a display, a GPU driver or hundreds of megabytes.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Ints

from triquad_tools.plots.camera import Camera, view_axes
from triquad_tools.plots.raster import Raster, rasterise, vertex_normals

_SUPERSAMPLING = 2
_SHADOW_PIXELS = 3072
_TOWARDS_SUN = np.array([-0.50, -0.58, 0.64]) / np.linalg.norm([-0.50, -0.58, 0.64])

# Colours are linear light in [0, 1].
_SUN = np.array([1.0, 0.93, 0.80]) * 1.08
_SKY_LIGHT = np.array([0.55, 0.68, 0.90]) * 0.50
_GROUND_LIGHT = np.array([0.50, 0.44, 0.38]) * 0.22
_SKY_TOP = np.array([0.52, 0.67, 0.85])
_SKY_LOW = np.array([0.90, 0.93, 0.96])
_BACK = 0.45  # brightness of faces seen from inside

_HEIGHT_STOPS = np.array(
    [
        [0.13, 0.30, 0.45],
        [0.18, 0.52, 0.50],
        [0.62, 0.72, 0.42],
        [0.90, 0.65, 0.32],
        [0.78, 0.32, 0.25],
    ]
)


def render_mesh(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    colours: NDArray[np.floating],
    camera: Camera,
    width: int = 1600,
    height: int = 900,
) -> Bytes:
    """A picture ``[height, width, 3]`` of a mesh.

    Args:
        vertices: ``[V, 3]`` metres, map frame.
        faces: ``[F, 3]`` rows of vertices, counter-clockwise seen from outside; those seen from
            inside are drawn darker.
        colours: ``[V, 3]`` of the vertices, linear in [0, 1].
        camera: where it is taken from.
        width: pixels.
        height: pixels.
    """
    wide, high = width * _SUPERSAMPLING, height * _SUPERSAMPLING
    picture = _sky(wide, high)
    if len(faces):
        points = np.ascontiguousarray(vertices, np.float64)
        rows = np.ascontiguousarray(faces, np.int32)
        raster = rasterise(camera.project(points, wide, high), rows, width=wide, height=high)
        light = _shade(points, rows, camera, raster=raster, colours=colours)
        covered = raster.faces >= 0
        picture[covered] = light * _contact_shadow(raster)[covered, None]
    fine = picture.reshape(height, _SUPERSAMPLING, width, _SUPERSAMPLING, 3)
    return _encode(fine.mean(axis=(1, 3)))


def height_colours(vertices: NDArray[np.floating]) -> Doubles:
    """Colours ``[V, 3]`` of vertices by their height, blue below to red above."""
    if not len(vertices):
        return np.zeros((0, 3))
    low, high = np.quantile(vertices[:, 2], [0.01, 0.99])
    place = (vertices[:, 2] - low) / max(float(high - low), 1e-6)
    stops = np.linspace(0.0, 1.0, len(_HEIGHT_STOPS))
    return np.stack([np.interp(place, stops, channel) for channel in _HEIGHT_STOPS.T], axis=1)


def _shade(
    points: Doubles, faces: Ints, camera: Camera, raster: Raster, colours: NDArray[np.floating]
) -> Doubles:
    """Light ``[P, 3]`` that the covered pixels send, in the order of the picture's rows."""
    covered = raster.faces >= 0
    owners, weights = faces[raster.faces[covered]], raster.weights[covered]
    places = camera.unproject(np.where(covered, raster.nearness, 1.0))[covered]
    normals = _blend(vertex_normals(points, faces), owners, weights)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    inside = _seen_from_inside(points[owners], camera.eye)
    normals[inside] *= -1.0
    sun = np.maximum(normals @ _TOWARDS_SUN, 0.0) * _sunlit(points, faces, places, normals)
    up = (0.5 + 0.5 * normals[:, 2])[:, None]
    light: Doubles = sun[:, None] * _SUN + up * _SKY_LIGHT + (1.0 - up) * _GROUND_LIGHT
    light *= _blend(colours, owners, weights)
    light[inside] *= _BACK
    return light


def _blend(values: NDArray[np.floating], owners: Ints, weights: Floats) -> Doubles:
    """Values ``[P, 3]`` of pixels from those of vertices ``[V, 3]``."""
    blended = np.zeros((len(owners), 3))
    for corner in range(3):
        blended += weights[:, corner, None] * values[owners[:, corner]]
    return blended


def _seen_from_inside(corners: Doubles, eye: Doubles) -> Bools:
    """Whether faces with corners ``[P, 3, 3]`` turn their back to the eye."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away: Bools = np.einsum("pi,pi->p", normals, corners[:, 0] - eye) > 0.0
    return away


def _sunlit(points: Doubles, faces: Ints, places: Doubles, normals: Doubles) -> Doubles:
    """Share of the sun ``[P]`` that reaches places ``[P, 3]``: a shadow map, softened."""
    axes = view_axes(-_TOWARDS_SUN)
    seen = points @ axes.T
    low = seen[:, :2].min(axis=0)
    metres = max(float((seen[:, :2].max(axis=0) - low).max()) / (_SHADOW_PIXELS - 2), 1e-9)

    def picture(at: Doubles) -> Doubles:
        inside = at @ axes.T
        return np.column_stack([(inside[:, :2] - low) / metres + 1.0, -inside[:, 2]])

    shadows = rasterise(
        picture(points), faces, width=_SHADOW_PIXELS, height=_SHADOW_PIXELS
    ).nearness
    # A step off the surface, so that it does not shade itself.
    off = picture(places + 2.5 * metres * normals)
    columns, rows = off[:, 0].astype(np.int64), off[:, 1].astype(np.int64)
    lit = np.zeros(len(places))
    for dx, dy in ((0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)):
        x = np.clip(columns + dx, 0, _SHADOW_PIXELS - 1)
        y = np.clip(rows + dy, 0, _SHADOW_PIXELS - 1)
        lit += 0.2 * (shadows[y, x] <= off[:, 2] + metres)
    return lit


def _contact_shadow(raster: Raster) -> Floats:
    """Brightness ``[H, W]``: darker where a pixel lies behind what surrounds it."""
    step = _SUPERSAMPLING  # soft: the finer pixels would show no more
    nearness = raster.nearness[::step, ::step].astype(np.float32)
    covered = np.isfinite(nearness)
    depth = np.where(covered, 1.0 / np.where(covered, nearness, 1.0), 0.0)
    brightness = np.ones_like(depth)
    for sigma in (0.004 * len(depth), 0.016 * len(depth)):
        share = np.maximum(gaussian_filter(covered.astype(np.float32), sigma), 1e-6)
        around = gaussian_filter(depth, sigma) / share
        behind = np.maximum(depth - around, 0.0) / np.maximum(depth, 1e-6)
        brightness -= 0.3 * np.minimum(behind * 60.0, 1.0)
    return brightness.repeat(step, axis=0).repeat(step, axis=1)


def _sky(width: int, height: int) -> Doubles:
    down = np.linspace(0.0, 1.0, height)[:, None, None]
    return np.repeat(_SKY_TOP + (_SKY_LOW - _SKY_TOP) * down, width, axis=1)


def _encode(light: Doubles) -> Bytes:
    """Linear light as 8-bit sRGB, near enough."""
    levels = np.round(255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / 2.2))
    return np.asarray(levels, np.uint8)
