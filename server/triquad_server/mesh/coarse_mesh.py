"""A coarse mesh of a region: large faces where the surface is flat, small ones where it bends.

Vertices that lie close together become one. That never tears the surface: a face that loses a
corner goes, and its neighbours close up.
"""

import numpy as np
from numpy.typing import NDArray
from triquad_format.records import morton
from triquad_format.records.arrays import Bools, Doubles, Longs
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import Region

from triquad_server.mesh.surface_net import NET_LEAVES, Distances, SurfaceNet, surface_net

CLUSTER_LEVELS = 3
"""Cubes of up to ``2**CLUSTER_LEVELS`` cells along each side become one vertex: 3.2 m."""

FACES_MAX = 100_000
PARAMETERS_A_FACE = 150  # so that a preview takes some 2.5 % of a map file of fp16
FACES_MIN = 2_000  # which any preview may have
"""How many faces a region has at most, by the size of its field."""

_FLAT_CELLS = 0.2
"""Vertices are merged that lie so near to a plane: 8 cm; more, where a mesh is too large."""

_COARSER = 1.5  # times that, in each step
_FORCED = 6  # steps after which cubes are merged whatever they hold
_ONE_SIDE = 0.5  # length of the mean of unit normals: less where they look to many sides
_FOLDED = -0.8  # cosine of the angle by which merging turned a face

_LEVELS_MAX = 20  # one cube holds all of any region


def coarse_mesh(
    region: Region, settings: FieldSettings, distances: Distances
) -> tuple[Doubles, Longs]:
    """Vertices [V, 3], metres, map frame, and faces [F, 3], counter-clockwise from free space."""
    net = without_shreds(surface_net(region, settings, distances))
    for coarser in range(_FORCED + _LEVELS_MAX):
        vertices, faces = _merged(net, _clusters(net, coarser))
        if len(faces) <= faces_max(region):
            break
    side_m, origin = settings.leaf_m * NET_LEAVES, settings.region_corner(region.index)
    return vertices * side_m + origin, faces


def faces_max(region: Region) -> int:
    """The most faces that the preview of a region may have: a bounded part of any map file."""
    return min(max(region.parameters // PARAMETERS_A_FACE, FACES_MIN), FACES_MAX)


def without_shreds(net: SurfaceNet) -> SurfaceNet:
    """The net without what is but a strip, such as single rings of a lidar on far ground.

    Faces stay that are whole, with no corner on a rim, and those that touch such faces. Where that
    would leave less than half, nothing but strips has been seen: they stay.
    """
    whole = ~net.rim[net.quads].any(axis=1)
    touched = np.zeros(len(net.points), np.bool_)
    touched[net.quads[whole]] = True
    kept = np.asarray(touched[net.quads].any(axis=1))
    return net.of_faces(kept) if 2 * kept.sum() >= len(kept) else net


def _clusters(net: SurfaceNet, coarser: int) -> Longs:
    """The cluster [V] of each vertex, named by one of its vertices, in so many steps from fine.

    Cubes are merged where they are flat, and at last whatever they hold.
    """
    forced = coarser - _FORCED  # level up to which that is so
    limit = _FLAT_CELLS * _COARSER**coarser
    codes = morton.encode(net.cells)
    clusters = np.arange(len(codes))
    merged = np.ones(len(codes), np.bool_)
    for level in range(1, max(forced, CLUSTER_LEVELS) + 1):
        _, first, cube = np.unique(codes >> 3 * level, return_index=True, return_inverse=True)
        merged &= level <= forced or _flat(net, cube, limit)[cube]
        merged = (np.bincount(cube, ~merged) == 0)[cube]  # all of a cube, or nothing
        clusters[merged] = first[cube][merged]
    return clusters


def _flat(net: SurfaceNet, group: NDArray[np.intp], limit: float) -> Bools:
    """Which groups [G] of vertices [V] lie nearly in a plane, and look to one side of it.

    The other side may be that of a thin wall, or of a post: merged, they would vanish.
    """
    counts = np.bincount(group)
    offsets = net.points - (_sums(net.points, group) / counts[:, None])[group]
    products = offsets[:, :, None] * offsets[:, None, :]
    moments = _sums(products.reshape(-1, 9), group).reshape(-1, 3, 3) / counts[:, None, None]
    thin = np.linalg.eigvalsh(moments)[:, 0] < limit**2
    corners = group[net.quads.ravel()]
    normals = np.nan_to_num(_normals(net.points, net.quads[:, :3])).repeat(4, axis=0)
    mean = np.linalg.norm(_sums(normals, corners), axis=1) / np.bincount(corners)
    flat: Bools = thin & (mean > _ONE_SIDE)
    return flat


def _sums(values: Doubles, group: NDArray[np.intp]) -> Doubles:
    """Sums [G, D] of the values [V, D] of each group."""
    return np.stack([np.bincount(group, column) for column in values.T], axis=1)


def _merged(net: SurfaceNet, clusters: Longs) -> tuple[Doubles, Longs]:
    """Vertices [V, 3] in cells, and triangles [F, 3], of a net whose clusters become points."""
    names, cluster = np.unique(clusters, return_inverse=True)
    # What holds some of a rim goes to the middle of that: the surface does not shrink.
    rim = net.rim
    counted = rim | (np.bincount(cluster, rim, len(names)) == 0)[cluster]
    sums = _sums(np.where(counted[:, None], net.points, 0.0), cluster)
    vertices = sums / np.bincount(cluster, counted, len(names))[:, None]
    triangles = np.concatenate([net.quads[:, [0, 1, 2]], net.quads[:, [0, 2, 3]]])
    faces = cluster[triangles]
    # What turned over lies folded between its neighbours, which cover its place.
    turn = (_normals(vertices, faces) * _normals(net.points, triangles)).sum(axis=1)
    return _without_repeats(vertices, faces[turn > _FOLDED])


def _normals(points: Doubles, faces: NDArray[np.intp]) -> Doubles:
    """Unit normals [F, 3] of faces [F, 3]; NaN where a face has no area."""
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    with np.errstate(invalid="ignore"):
        unit: Doubles = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def _without_repeats(vertices: Doubles, faces: NDArray[np.intp]) -> tuple[Doubles, Longs]:
    """The mesh without double faces, and without vertices that no face uses.

    Faces are in the order of their least corner: neighbours share bytes, and compress well.
    """
    low, middle, high = np.sort(faces, axis=1).T
    count = len(vertices)
    _, first = np.unique((low * count + middle) * count + high, return_index=True)
    used, faces = np.unique(faces[first], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int64)
