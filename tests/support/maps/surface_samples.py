"""Area-uniform random points on the surface of a scene of solids."""

import math

import numpy as np
from numpy.typing import NDArray
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import BOX, CYLINDER, GABLE, HALF_SPACE, Solid

Points = NDArray[np.float64]

_ON_SURFACE_M = 1e-7


def surface_samples(scene: Scene, spacing_m: float, rng: np.random.Generator) -> Points:
    """Random points ``[M, 3]`` exactly on the surface, within the bounds.

    Their density is uniform: one per ``spacing_m ** 2`` of area on average. What lies hidden
    inside another solid is no surface and gets none.
    """
    density = 1.0 / spacing_m**2
    parts = [sample_surface(solid, density, scene.bounds, rng) for solid in scene.solids]
    points = np.concatenate(parts)
    inside = np.all((points >= scene.bounds[0]) & (points <= scene.bounds[1]), axis=1)
    points = points[inside]
    return np.asarray(points[scene.sdf(points) > -_ON_SURFACE_M])


def sample_surface(
    solid: Solid, density: float, bounds: NDArray[np.float64], rng: np.random.Generator
) -> Points:
    """Random points ``[M, 3]`` on the whole surface of a solid, world frame, metres.

    Args:
        solid: the solid.
        density: points per square metre.
        bounds: ``[2, 3]`` metres; cut a half-space, whose surface has no end.
        rng: source of randomness.
    """
    if solid.kind == HALF_SPACE:
        low, high = bounds[0, :2], bounds[1, :2]
        count = rng.poisson(density * float(np.prod(high - low)))
        flat = rng.uniform(low, high, (count, 2))
        return np.column_stack([flat, np.full(count, solid.centre[2])])
    makers = {BOX: _box, CYLINDER: _cylinder, GABLE: _gable}
    local = makers[solid.kind](solid.size, density, rng)
    cos, sin = math.cos(solid.yaw), math.sin(solid.yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    points: Points = local @ turn.T + np.asarray(solid.centre)
    return points


def _box(size: tuple[float, ...], density: float, rng: np.random.Generator) -> Points:
    """Points on a rounded box: faces, edges and corners of its core, pushed out by the radius."""
    core, radius = np.asarray(size[:3]), size[3]
    parts = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        faces = rng.poisson(density * 8.0 * float(np.prod(core[others])))
        side = rng.choice([-1.0, 1.0], faces)
        points = rng.uniform(-core, core, (faces, 3))
        points[:, axis] = side * (core[axis] + radius)
        # The four edges along this axis together make one full cylinder mantle.
        edges = rng.poisson(density * 4.0 * math.pi * radius * core[axis])
        angle = rng.uniform(0.0, 2.0 * math.pi, edges)
        normal = np.zeros((edges, 3))
        normal[:, others[0]], normal[:, others[1]] = np.cos(angle), np.sin(angle)
        rounded = np.sign(normal) * core + radius * normal
        rounded[:, axis] = rng.uniform(-core[axis], core[axis], edges)
        parts += [points, rounded]
    corners = rng.normal(size=(rng.poisson(density * 4.0 * math.pi * radius**2), 3))
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    return np.concatenate([*parts, np.sign(corners) * core + radius * corners])


def _cylinder(size: tuple[float, ...], density: float, rng: np.random.Generator) -> Points:
    radius, half_height = size[:2]
    mantle = rng.poisson(density * 4.0 * math.pi * radius * half_height)
    caps = rng.poisson(density * 2.0 * math.pi * radius**2)
    angle = rng.uniform(0.0, 2.0 * math.pi, mantle + caps)
    rho = np.full(mantle + caps, radius)
    rho[mantle:] *= np.sqrt(rng.uniform(size=caps))
    z = rng.uniform(-half_height, half_height, mantle + caps)
    z[mantle:] = rng.choice([-half_height, half_height], caps)
    return np.column_stack([rho * np.cos(angle), rho * np.sin(angle), z])


def _gable(size: tuple[float, ...], density: float, rng: np.random.Generator) -> Points:
    length, width, half_height, eave = size
    ridge = 2.0 * half_height
    # The half outline as edges (y, z) - (y, z); the other half is its mirror image.
    edges = (
        ((0.0, 0.0), (width, 0.0)),
        ((width, 0.0), (width, eave)),
        ((width, eave), (0.0, ridge)),
    )
    parts = []
    for start, end in edges:
        count = rng.poisson(density * 4.0 * length * math.dist(start, end))
        along = rng.uniform(size=(count, 1))
        yz = (1.0 - along) * np.asarray(start) + along * np.asarray(end)
        parts.append(np.column_stack([rng.uniform(-length, length, count), yz]))
    # Both ends: their bounding rectangles, of which the points under the roof stay.
    count = rng.poisson(density * 4.0 * width * ridge)
    y, z = rng.uniform(0.0, width, count), rng.uniform(0.0, ridge, count)
    under = z <= ridge - (ridge - eave) * y / width
    parts.append(np.column_stack([rng.choice([-length, length], count), y, z])[under])
    points = np.concatenate(parts)
    points[:, 1] *= rng.choice([-1.0, 1.0], len(points))
    points[:, 2] -= half_height
    return points
