"""A room seen by a depth camera, exactly, and the folders that hold such images."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from triquad_client.depth_image import Intrinsics

CAMERA = Intrinsics(60.0, 62.0, 31.5, 23.5)
WIDTH, HEIGHT = 64, 48
HALF_ROOM_M = 2.0


def room_depth(world_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depths [HEIGHT, WIDTH] of the walls of a cube around the origin, metres."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack(
        [(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(rows.shape)],
        axis=-1,
    )
    directions = rays @ world_from_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        reach = (np.sign(directions) * HALF_ROOM_M - world_from_camera[:3, 3]) / directions
    depth: NDArray[np.float64] = reach.min(axis=-1)
    return depth


def write_depth(path: Path, depth: NDArray[np.float64], units_per_metre: float) -> Path:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(depth * units_per_metre).astype(np.uint16)).save(path)
    return path


def write_intrinsics(path: Path, camera: Intrinsics = CAMERA, width: int = WIDTH) -> Path:
    matrix = [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1]
    said = {"width": width, "height": HEIGHT, "intrinsic_matrix": matrix}
    path.write_text(json.dumps(said))
    return path


def write_list(folder: Path, stamps_ns: Sequence[int]) -> list[Path]:
    """``depth.txt`` of TUM RGB-D; returns the paths of the images that it names."""
    names = [f"depth/{stamp // 10**9}.{stamp % 10**9 // 1000:06d}.png" for stamp in stamps_ns]
    lines = ["# depth maps", "# timestamp filename"]
    lines += [f"{name[6:-4]} {name}" for name in names]
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    return [folder / name for name in names]
