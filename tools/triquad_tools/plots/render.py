"""Pictures of meshes: shaded in software, with a sun, its shadows and a soft sky.

All light is white, so that shading makes a colour darker, but never another one: a legend holds.
Own code, as the libraries that do this want a display, a GPU driver or hundreds of megabytes.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from triquad_format.records.arrays import Bools, Bytes, Doubles, Floats, Ints
from triquad_map.height_scale import GAMMA

from triquad_tools.plots.camera import Camera, view_axes
from triquad_tools.plots.mesh_normals import vertex_normals
from triquad_tools.plots.raster import Raster, rasterise

_SUPERSAMPLING = 2
_SHADOW_PIXELS = 3072
_SUN_BESIDE_DEG, _SUN_UP_DEG = 45.0, 40.0  # over the left shoulder, as maps are lit

# Linear light: level ground in the sun has its own colour.
_SUN = 0.85
_SKY_LIGHT = 0.45
_GROUND_LIGHT = 0.20
_BACK = 0.45  # brightness of faces seen from inside

BACKGROUND: Doubles = np.array([0.93, 0.94, 0.95])
"""sRGB of where nothing is."""


def render_mesh(
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    colours: NDArray[np.floating],
    *,
    camera: Camera,
    width: int = 1600,
    height: int = 900,
    plain: int = 0,
) -> Bytes:
    """A picture ``[height, width, 3]`` of a mesh.

    Args:
        vertices: ``[V, 3]`` metres, map frame.
        faces: ``[F, 3]`` rows of vertices, counter-clockwise seen from outside; those seen from
            inside are drawn darker.
        colours: ``[V, 3]`` of the vertices, sRGB in [0, 1].
        camera: where it is taken from.
        width: pixels.
        height: pixels.
        plain: so many of the last faces have their colours from all sides, without any light.
    """
    wide, high = width * _SUPERSAMPLING, height * _SUPERSAMPLING
    picture = np.tile(_linear(BACKGROUND), (high, wide, 1))
    if len(faces):
        points = np.ascontiguousarray(vertices, np.float64)
        rows = np.ascontiguousarray(faces, np.int32)
        raster = rasterise(camera.project(points, wide, high), rows, width=wide, height=high)
        covered = raster.faces >= 0
        light = _shade(points, rows, camera, raster=raster, plain=plain)[:, None]
        owners, weights = rows[raster.faces[covered]], raster.weights[covered]
        light = light * _blend(_linear(colours), owners, weights)
        picture[covered] = light * _contact_shadow(raster, camera)[covered, None]
    fine = picture.reshape(height, _SUPERSAMPLING, width, _SUPERSAMPLING, 3)
    return _encode(fine.mean(axis=(1, 3)))


def _shade(points: Doubles, faces: Ints, camera: Camera, raster: Raster, plain: int) -> Doubles:
    """Light ``[P]`` that falls on the covered pixels, in the order of the picture's rows."""
    shaded = len(faces) - plain
    covered = raster.faces >= 0
    owners, weights = faces[raster.faces[covered]], raster.weights[covered]
    places = camera.unproject(np.where(covered, raster.nearness, 1.0))[covered]
    normals = _blend(vertex_normals(points, faces[:shaded]), owners, weights)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    inside = ~facing(points[owners], camera)
    normals[inside] *= -1.0
    towards_sun = _towards_sun(camera)
    lit = _sunlit(points, faces[:shaded], places, normals=normals, towards_sun=towards_sun)
    up = 0.5 + 0.5 * normals[:, 2]
    light = np.maximum(normals @ towards_sun, 0.0) * lit * _SUN
    light += up * _SKY_LIGHT + (1.0 - up) * _GROUND_LIGHT
    light[inside] *= _BACK
    light[raster.faces[covered] >= shaded] = 1.0
    return np.asarray(light)


def _towards_sun(camera: Camera) -> Doubles:
    """The direction ``[3]`` of the sun: behind the camera, and to its left."""
    right = camera.axes[0]
    beside, up = math.radians(_SUN_BESIDE_DEG), math.radians(_SUN_UP_DEG)
    back = np.array([right[1], -right[0], 0.0])
    level = math.cos(beside) * back - math.sin(beside) * right
    return np.asarray(math.cos(up) * level + [0.0, 0.0, math.sin(up)])


def _blend(values: NDArray[np.floating], owners: Ints, weights: Floats) -> Doubles:
    """Values ``[P, 3]`` of pixels from those of vertices ``[V, 3]``."""
    blended = np.zeros((len(owners), 3))
    for corner in range(3):
        blended += weights[:, corner, None] * values[owners[:, corner]]
    return blended


def facing(corners: NDArray[np.floating], camera: Camera) -> Bools:
    """Whether faces with corners ``[F, 3, 3]`` show the camera their outer side."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = camera.towards_eye(corners[:, 0].astype(np.float64))
    shown: Bools = (normals * towards).sum(axis=1) > 0.0
    return shown


def _sunlit(
    points: Doubles, faces: Ints, places: Doubles, normals: Doubles, towards_sun: Doubles
) -> Doubles:
    """Share of the sun ``[P]`` that reaches places ``[P, 3]``: a shadow map, softened."""
    axes = view_axes(-towards_sun)
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


def _contact_shadow(raster: Raster, camera: Camera) -> Doubles:
    """Brightness ``[H, W]``: darker where a pixel lies behind what surrounds it."""
    step = _SUPERSAMPLING  # soft: the finer pixels would show no more
    nearness = raster.nearness[::step, ::step]
    covered = np.isfinite(nearness)
    depth = camera.relative_depth(np.where(covered, nearness, 1.0))
    brightness = np.ones_like(depth)
    for sigma in (0.004 * len(depth), 0.016 * len(depth)):
        share = np.maximum(gaussian_filter(covered.astype(np.float32), sigma), 1e-6)
        around = gaussian_filter(depth * covered, sigma) / share
        behind = np.maximum(depth - around, 0.0)
        brightness -= 0.3 * np.minimum(behind * 38.0, 1.0)
    return brightness.repeat(step, axis=0).repeat(step, axis=1)


def _linear(colours: NDArray[np.floating]) -> Doubles:
    """Linear light of sRGB colours."""
    light: Doubles = np.asarray(colours, np.float64) ** GAMMA
    return light


def _encode(light: Doubles) -> Bytes:
    """Linear light as 8-bit sRGB."""
    levels = np.round(255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / GAMMA))
    return np.asarray(levels, np.uint8)
