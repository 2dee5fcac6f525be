"""Tubes in a scene: along paths, and as arrows, each with a pale outline."""

from dataclasses import dataclass

import numpy as np
import viser
from triquad_format.records.arrays import Doubles
from triquad_map.height_scale import GAMMA

from triquad_tools.viewer.page.page import Page
from triquad_tools.viewer.page.unlit_glb import Triangles, unlit_glb

_SIDES = 8
_OUTLINE = 1.35  # its radius, as a multiple
_HEAD_LENGTH, _HEAD_RADIUS, _NECK = 0.3, 2.5, 1e-3  # of an arrow, shares of its length and radius


@dataclass(frozen=True)
class Tube:
    """Pieces of tube between points, metres, map frame."""

    points: Doubles  # [P + 1, 3] no two of them in a row the same
    radii_m: Doubles  # [P + 1]
    colours: Doubles  # [P, 3] of the pieces, sRGB in [0, 1]


def arrow(start: Doubles, along: Doubles, radius_m: float, colour: Doubles) -> Tube:
    """A tube from ``start`` [3] along a vector [3] that ends in a cone."""
    neck = 1.0 - _HEAD_LENGTH
    places = np.array([0.0, neck, neck + _NECK, 1.0])
    radii_m = radius_m * np.array([1.0, 1.0, _HEAD_RADIUS, 0.0])
    return Tube(start + places[:, None] * along, radii_m, np.tile(colour, (3, 1)))


def add_tube(page: Page, name: str, tube: Tube) -> viser.GlbHandle:
    """Draw a tube."""
    corner = tube.points[0]
    points = tube.points - corner
    inner = tube_mesh(points, tube.radii_m)
    outer = tube_mesh(points, _OUTLINE * tube.radii_m)
    # Only the far inside of the outline is drawn: a rim that is seen around the tube.
    behind = outer.faces[:, ::-1] + len(inner.vertices)
    light = np.repeat(tube.colours**GAMMA, 2 * _SIDES, axis=0)
    both = Triangles(
        np.concatenate([inner.vertices, outer.vertices]), np.concatenate([inner.faces, behind])
    )
    return page.add_glb(name, unlit_glb(both, np.concatenate([light, np.ones_like(light)])), corner)


def tube_mesh(points: Doubles, radii_m: Doubles) -> Triangles:
    """Eight sides around each piece between ``points`` [P + 1, 3], of radii [P + 1].

    Each piece has two rings of eight vertices of its own. Faces are counter-clockwise from outside.
    """
    ahead = np.diff(points, axis=0)
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    least = np.eye(3)[np.abs(ahead).argmin(axis=1)]  # far from parallel
    across = np.cross(ahead, least)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angles = np.arange(_SIDES)[:, None] * (2.0 * np.pi / _SIDES)
    around = np.cos(angles) * across[:, None] + np.sin(angles) * np.cross(ahead, across)[:, None]
    first = points[:-1, None] + radii_m[:-1, None, None] * around
    second = points[1:, None] + radii_m[1:, None, None] * around
    vertices = np.stack([first, second], axis=1).reshape(-1, 3)
    side = np.arange(_SIDES)
    after = (side + 1) % _SIDES
    lower = np.stack([side, after, after + _SIDES], axis=1)
    upper = np.stack([side, after + _SIDES, side + _SIDES], axis=1)
    pieces = np.arange(len(ahead))[:, None, None] * 2 * _SIDES
    faces = (pieces + np.concatenate([lower, upper])).reshape(-1, 3)
    return Triangles(vertices.astype(np.float32), faces.astype(np.int32))
