"""A world that moves: what is removed disappears from the map, with all that was made from it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.files.mapfile_edit import file_bytes, read_bytes
from support.maps.small_world import WALLED, WALLED_BOUNDS, settings, settle
from support.poses import shifted
from triquad_client import Mesh
from triquad_format.records.arrays import Doubles, Longs
from triquad_format.records.region import Region
from triquad_format.records.status import Status
from triquad_map.evidence.evidence import FrozenEvidence
from triquad_map.mesh.marching_cubes import centroids
from triquad_map.mesh.tile_mesh import mesh_tile
from triquad_map.surfels.surfel_tree import surfel_voxels
from triquad_server.epochs.epoch import Epoch, FrozenRegion
from triquad_server.mapping.mapper import Mapper
from triquad_server.mesh.tile_cache import tile_lattice
from triquad_server.settings import MeshSettings, Settings
from triquad_tools.simulation.lidar import Lidar
from triquad_tools.simulation.scene import Scene
from triquad_tools.simulation.solids import Solid, box

CENTRE, HALF = np.array([5.0, 0.5, 0.45]), np.array([0.6, 0.9, 0.45])
BOX = box((5.0, 0.5, 0.45), (0.6, 0.9, 0.45))


class Watched:
    """A map of a place, which a sensor keeps scanning while it moves back and forth."""

    def __init__(self, chosen: Settings | None = None) -> None:
        self.settings = chosen or settings(samples_per_ray=6.0)
        self.mapper = Mapper("test", self.settings, "cpu")
        self.scans = 0

    def scan(self, *there: Solid, count: int, steps: int = 4) -> Epoch:
        """Take in some scans of the place with what is ``there`` besides, and publish."""
        scene = Scene((*WALLED, *there), WALLED_BOUNDS)
        for _ in range(count):
            pose = shifted(0.5 * np.sin(0.7 * self.scans), 0.3 * np.cos(self.scans), 1.4)
            made = Lidar(columns=1024).scan(scene, pose, np.random.default_rng(self.scans))
            self.mapper.ingest(made.points, pose, stamp_s=self.scans)
            self.scans += 1
            for _ in range(steps):
                self.mapper.train()
            if self.scans % 2 == 0:
                self.mapper.publish()
        return self.mapper.publish()

    def restart(self, edit: Callable[[Region], Region] = lambda region: region) -> None:
        """Go on from a file of the map, as a server does that was started again."""
        record = read_bytes(file_bytes(self.mapper.snapshot_since(None).record()))
        bare = tuple(edit(replace(region, training=None)) for region in record.regions)
        self.mapper = Mapper("test", self.settings, "cpu", replace(record, regions=bare))


def main_region(epoch: Epoch) -> FrozenRegion:
    """The region in which nearly everything stands."""
    return max(epoch.frozen_regions, key=lambda region: len(region.evidence.levels))


def surface_voxels(evidence: FrozenEvidence) -> Longs:
    """Voxels [N, 3] in which surface is believed."""
    return surfel_voxels(evidence.cells, evidence.surface, len(evidence.levels))


def voxel_centres(region: FrozenRegion, voxels: Longs) -> Doubles:
    """Middles [N, 3] of voxels of a region."""
    return region.centre + (voxels + 0.5 - (1 << 7)) * 0.2


def faces(count: int = 400) -> Doubles:
    """Points [N, 3] on the faces of the box that the sensor sees, away from its edges."""
    rng = np.random.default_rng(5)
    points = CENTRE + 0.8 * HALF * rng.uniform(-1, 1, (count, 3))
    points[: count // 2, 0] = CENTRE[0] - HALF[0]
    points[count // 2 :, 2] = CENTRE[2] + HALF[2]
    return points[points[:, 2] > 0.3]


def share(epoch: Epoch, status: Status, front: bool = False) -> float:
    """Share of the points on the box's faces, or on its front alone, that have a status."""
    points = faces()
    if front:  # the top is seen at a grazing angle
        points = points[points[:, 0] < CENTRE[0] - 0.9 * HALF[0]]
    return float((epoch.status(points) == status).mean())


def mesh_area(epoch: Epoch) -> float:
    """Area of the mesh where the box stood, square metres; the ground below is not counted."""
    lattice, area = tile_lattice(MeshSettings(), 0), 0.0
    low, high = CENTRE - HALF - 0.1, CENTRE + HALF + 0.1
    low[2] = 0.25
    for x, y, z in lattice.tiles_meeting(low[None], high[None]).tolist():
        tile = mesh_tile(epoch, (x, y, z), lattice)
        vertices = tile.triangles.vertices
        middles = centroids(vertices, tile.faces)
        inside = ((middles > low) & (middles < high)).all(axis=1)
        area += Mesh(vertices, tile.faces[inside]).to_trimesh().area
    return area


@dataclass(frozen=True)
class Course:
    """A box stood there, and is gone."""

    watched: Watched
    before: Epoch  # with the box
    soon: Epoch  # 10 scans after it went
    later: Epoch  # 31 scans after it went


@pytest.fixture(scope="module")
def gone() -> Course:
    watched = Watched()
    before, soon = watched.scan(BOX, count=8), watched.scan(count=10)
    assert share(watched.scan(count=1), Status.FREE, front=True) > 0.95
    return Course(watched, before, soon, watched.scan(count=20))


def test_what_is_gone_leaves_nothing_behind(gone: Course) -> None:
    assert share(gone.before, Status.SURFACE) > 0.95
    assert mesh_area(gone.before) > 1.0
    assert mesh_area(gone.soon) < 0.05
    assert share(gone.later, Status.FREE) > 0.9
    assert mesh_area(gone.later) < 0.05
    nearest = gone.later.nearest_surface(CENTRE[None], 2.0)
    assert nearest.distance[0] > 0.4  # the ground, and no surfel of the box


def test_the_field_learns_that_it_is_free_there(gone: Course) -> None:
    free = faces()[faces()[:, 2] > 0.5]
    assert np.median(gone.later.query(free).sdf) > 0.1


@pytest.mark.long
def test_a_settled_map_that_is_seen_again_in_part_unlearns_what_was_removed() -> None:
    chosen = settings(samples_per_ray=30.0)
    watched = Watched(chosen.model_copy(update={"field": Settings().field}))
    watched.scan(BOX, count=8)
    settle(watched.mapper)
    faced = watched.mapper.publish()
    scene = Scene(WALLED, WALLED_BOUNDS)
    for number in range(20):
        pose = shifted(0.0, 0.05 * number, 1.4)
        made = Lidar(columns=1024).scan(scene, pose, np.random.default_rng(number))
        ahead = np.abs(np.arctan2(made.points[:, 1], made.points[:, 0])) < 0.25
        watched.mapper.ingest(made.points[ahead], pose, stamp_s=100 + number)
        for _ in range(8):
            watched.mapper.train()
        watched.mapper.publish()
    settle(watched.mapper)
    after = watched.mapper.publish()
    free = faces()[faces()[:, 2] > 0.5]
    free = free[free[:, 0] < CENTRE[0] - 0.9 * HALF[0]]
    assert np.median(np.abs(faced.query(free).sdf)) < 0.05
    assert np.median(after.query(free).sdf) > 0.07


def test_what_stands_keeps_its_surface(gone: Course) -> None:
    voxels = surface_voxels(main_region(gone.before).evidence)
    now = main_region(gone.later)
    centres = voxel_centres(now, voxels)
    standing = Scene(WALLED, WALLED_BOUNDS).sdf(centres) < 0.05
    away = (np.abs(centres - CENTRE) > HALF + 0.4).any(axis=1)
    assert now.evidence.ended_in(voxels[standing & away]).mean() > 0.997


def test_in_a_static_world_nothing_is_removed() -> None:
    chosen = settings(samples_per_ray=6.0)
    still = chosen.model_copy(update={"change": chosen.change.model_copy(update={"static": True})})
    watched = Watched(still)
    watched.scan(BOX, count=8)
    assert share(watched.scan(count=10), Status.SURFACE) > 0.95


def test_a_restored_map_stays_until_rays_contradict_it() -> None:
    watched = Watched()
    before = main_region(watched.scan(BOX, count=8))
    voxels = surface_voxels(before.evidence)
    watched.restart()
    assert main_region(watched.mapper.publish()).evidence.ended_in(voxels).all()
    same = main_region(watched.scan(BOX, count=6)).evidence
    assert same.ended_in(voxels).mean() > 0.997
    watched.restart()
    watched.mapper.publish()
    assert share(watched.scan(count=14), Status.SURFACE, front=True) < 0.05


@pytest.mark.long
def test_rays_that_come_back_from_beyond_the_range_contradict() -> None:
    left = []
    for seed in range(4):  # few rays of a scan are taken for this, at random
        chosen = settings(samples_per_ray=6.0, seed=seed)
        scan = chosen.scan.model_copy(update={"range_max_m": 6.5})
        watched = Watched(chosen.model_copy(update={"scan": scan}))
        assert share(watched.scan(BOX, count=8), Status.SURFACE, front=True) > 0.95
        left.append(share(watched.scan(count=20), Status.SURFACE, front=True))
    assert np.mean(left) < 0.35


def test_confidence_falls_before_it_is_removed() -> None:
    watched = Watched()
    before = watched.scan(BOX, count=8, steps=15).nearest_surface(faces(), 0.3)
    after = watched.scan(count=1, steps=0).nearest_surface(faces(), 0.3)
    still = before.found & after.found
    assert still.mean() > 0.5
    fell = after.confidence[still] < before.confidence[still]
    rose = after.confidence[still] > before.confidence[still]  # what is nearest may be another disc
    assert fell.mean() > 0.3
    assert rose.mean() < 0.5 * fell.mean()
