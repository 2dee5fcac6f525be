"""A map whose answers are exact: those of a scene, wherever it lies in the map frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from triquad_format.records.status import Status
from triquad_map.view import FieldAnswer, NearestSurface, NearestUnknown
from triquad_tools.simulation.scene import Scene


@dataclass(frozen=True)
class ExactView:
    """A :class:`MapView` of a scene, of which a box is seen; all else is unknown."""

    scene: Scene
    map_from_scene: NDArray[np.float64]  # [4, 4]
    seen_low: NDArray[np.float64]  # [3] corner of the box, scene frame
    seen_high: NDArray[np.float64]  # [3]
    epoch: int = 7
    voxel_m: float = 0.2

    def query(self, points: NDArray[np.float64], gradient: bool = False) -> FieldAnswer:
        local = self._local(points)
        sdf = self.scene.sdf(local).astype(np.float32)
        slopes = self.scene.gradient(local) @ self.map_from_scene[:3, :3].T
        return FieldAnswer(
            sdf, self.status(points), slopes.astype(np.float32) if gradient else None
        )

    def status(
        self, points: NDArray[np.float64], reach_m: float | None = None
    ) -> NDArray[np.uint8]:
        reach_m = self.voxel_m if reach_m is None else reach_m
        local = self._local(points)
        sdf = self.scene.sdf(local)
        status = np.where(sdf > 0, Status.FREE, Status.UNKNOWN)
        status = np.where(np.abs(sdf) < reach_m, Status.SURFACE, status)
        return np.where(self._seen(local), status, Status.UNKNOWN).astype(np.uint8)

    def nearest_surface(self, points: NDArray[np.float64], max_distance_m: float) -> NearestSurface:
        local = self._local(points)
        sdf = self.scene.sdf(local)
        closest = local - sdf[:, None] * self.scene.gradient(local)
        found = (np.abs(sdf) <= max_distance_m) & self._seen(closest)
        world = closest @ self.map_from_scene[:3, :3].T + self.map_from_scene[:3, 3]
        world[~found] = 0.0
        distance = np.where(found, np.abs(sdf), max_distance_m)
        away = (points - world) / np.maximum(np.abs(sdf), 1e-9)[:, None]
        away[~found] = 0.0
        confidence, normal = found.astype(np.float32), np.zeros(points.shape, np.float32)
        return NearestSurface(found, distance, world, away, confidence, np.ones_like(found), normal)

    def nearest_unknown(self, points: NDArray[np.float64], max_distance_m: float) -> NearestUnknown:
        local = self._local(points)
        behind = self.scene.sdf(local) + self.voxel_m  # where the status of a solid begins
        nearest = local - behind[:, None] * self.scene.gradient(local)
        gaps = np.hstack([local - self.seen_low, self.seen_high - local])  # [N, 6] to the faces
        face, out = gaps.argmin(axis=1), gaps.min(axis=1)
        rows = np.flatnonzero(out < behind)
        nearest[rows] = local[rows]
        nearest[rows, face[rows] % 3] = np.append(self.seen_low, self.seen_high)[face[rows]]
        distance = np.clip(np.minimum(behind, out), 0.0, max_distance_m)
        nearest[distance == 0.0] = local[distance == 0.0]
        world = nearest @ self.map_from_scene[:3, :3].T + self.map_from_scene[:3, 3]
        return NearestUnknown(distance, world)

    def _local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return (points - self.map_from_scene[:3, 3]) @ self.map_from_scene[:3, :3]

    def _seen(self, local: NDArray[np.float64]) -> NDArray[np.bool_]:
        return ((local >= self.seen_low) & (local <= self.seen_high)).all(axis=1)
