"""Other mappers on the same scans, where they are installed: explicit grids of averaged distances.

Both take voxels of 10 cm and truncate distances at 30 cm, as 3QFP has them in section IV.
"""

from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles

from triquad_tools.console.progress import progress
from triquad_tools.paper.intake import in_range
from triquad_tools.sensors.sweep import PosedScan, moved

VOXEL_M, TRUNCATION_M = 0.1, 0.3

_PIXELS = 128  # of 90 degrees of a depth image, which has one more at each side
_BLOCKS = 100_000  # of 8^3 voxels, for which there is room at first
FACES = np.array(
    [
        [[0, -1, 0], [0, 0, -1], [1, 0, 0]],  # ahead: right, down and forward as rows
        [[0, 1, 0], [0, 0, -1], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, -1, 0], [-1, 0, 0], [0, 0, -1]],
    ],
    np.float64,
)
"""[6, 3, 3] rotations from the sensor to cameras that look at the faces of a cube."""


def installed_mappers() -> dict[str, Callable[[Sequence[PosedScan]], Mesh]]:
    """Return what makes a mesh of scans, by the mapper's name.

    The wheels of VDBFusion, up to Python 3.10, crash with numpy 2: it is left out there.
    """
    mappers: dict[str, Callable[[Sequence[PosedScan]], Mesh]] = {}
    if find_spec("vdbfusion") is not None and np.__version__.startswith("1."):
        mappers["VDBFusion"] = vdbfusion_mesh
    if find_spec("open3d") is not None:
        mappers["Open3D"] = open3d_mesh
    return mappers


def vdbfusion_mesh(scans: Sequence[PosedScan]) -> Mesh:
    """Return the mesh of VDBFusion (Vizzo et al., Sensors 2022) of scans."""
    import vdbfusion

    volume = vdbfusion.VDBVolume(VOXEL_M, TRUNCATION_M, space_carving=False)
    for points, pose in _used(scans, "VDBFusion"):
        volume.integrate(moved(points, pose), pose)
    vertices, faces = volume.extract_triangle_mesh(fill_holes=False, min_weight=0.0)
    return Mesh(vertices, faces.astype(np.int32), None)


def open3d_mesh(scans: Sequence[PosedScan]) -> Mesh:
    """Return the mesh of Open3D's TSDF, a ``VoxelBlockGrid`` (Dong et al., 2021), of scans.

    It takes depth images, so a scan becomes six: those of the faces of a cube.
    """
    import open3d
    import open3d.core as core

    grid = open3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"),
        (core.float32, core.float32),
        ((1,), (1,)),
        voxel_size=VOXEL_M,
        block_resolution=8,
        block_count=_BLOCKS,
    )
    half = _PIXELS / 2  # a pixel is found by rounding down, as in the images
    pinhole = core.Tensor([[half, 0.0, half + 1], [0.0, half, half + 1], [0.0, 0.0, 1.0]])
    ratio = TRUNCATION_M / VOXEL_M
    for points, pose in _used(scans, "Open3D"):
        if not len(points):
            continue
        ends = open3d.t.geometry.PointCloud(core.Tensor(moved(points, pose).astype(np.float32)))
        # Of an image it would look at one pixel in sixteen.
        blocks = grid.compute_unique_block_coordinates(ends, ratio)
        farthest = float(np.linalg.norm(points, axis=1).max())
        for face in FACES:
            camera = np.eye(4)
            camera[:3, :3] = face
            extrinsic = core.Tensor(camera @ np.linalg.inv(pose))
            depth = open3d.t.geometry.Image(core.Tensor(depth_image(points @ face.T)[:, :, None]))
            scale = (1.0, farthest)  # metres in a unit of depth, and the largest depth
            grid.integrate(blocks, depth, pinhole, extrinsic, *scale, ratio)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.0)  # whatever was seen once
    faces = mesh.triangle.indices.numpy().astype(np.int32)
    return Mesh(mesh.vertex.positions.numpy().astype(np.float64), faces, None)


def depth_image(points: Doubles) -> NDArray[np.float32]:
    """Return the nearest depths of points [N, 3], camera frame, in metres; 0: nothing is there.

    Its field of view is 90 degrees, with a pixel more at each side.
    """
    side = _PIXELS + 2
    ahead = points[points[:, 2] > 0]
    pixels = np.floor(ahead[:, :2] / ahead[:, 2:] * (_PIXELS / 2) + side / 2)
    pixels = pixels.clip(-1, side).astype(int)
    inside = ((pixels >= 0) & (pixels < side)).all(axis=1)
    points, pixels = ahead[inside], pixels[inside]
    image = np.full((side, side), np.inf, np.float32)
    np.minimum.at(image, (pixels[:, 1], pixels[:, 0]), points[:, 2].astype(np.float32))
    image[np.isinf(image)] = 0.0
    return image


def _used(scans: Sequence[PosedScan], name: str) -> Iterator[tuple[Doubles, Doubles]]:
    """Yield the points of each scan that are used, sensor frame, and its pose."""
    with progress(name, len(scans)) as report:
        for number, scan in enumerate(scans):
            points = in_range(np.asarray(scan.points, np.float64))
            yield points, np.asarray(scan.world_from_sensor, np.float64)
            report(number, f"{number} of {len(scans)} scans")
