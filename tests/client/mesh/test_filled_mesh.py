"""Holes in the meshes of map files: filled where the field continues what was seen, and marked."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from support.maps.exact_maps import SETTINGS, Height, exact_map, flat
from support.maps.map_records import with_evidence, with_region
from support.maps.small_world import settled_epoch, world
from triquad_client import InvalidInputError, Mesh, OfflineMap
from triquad_format.records import morton
from triquad_format.records.field_settings import BLOCK_VOXELS
from triquad_format.records.region import MapRecord, masked, seen_voxels, surface_voxels
from triquad_format.records.status import Status

HALF = 1 << (SETTINGS.depth - 1)
HOLE = (5, 15)  # voxels along x and along y: 1 m to 3 m
HOLE_M2 = 4.0
EDGE = 10  # voxels along x
FIELD_MAX_M = 32.0


def ground(height: Height) -> MapRecord:
    """An exact map whose field has a gradient on the surface, too."""
    record = exact_map(height)
    mlp = record.regions[0].mlp
    above = np.array([1.0, -1.0], np.float32) * FIELD_MAX_M  # where the activation has no kink
    biases = (above, mlp.biases[1], -above[:1])
    return with_region(record, mlp=dataclasses.replace(mlp, biases=biases))


def with_hole(record: MapRecord, *, free: bool = False) -> MapRecord:
    """The map, had no ray ended in the hole; were rays ``free`` to pass, they did."""
    evidence = record.regions[0].evidence
    surface, open_air = evidence.surface.copy(), evidence.free.copy()
    blocks = morton.decode(evidence.codes, 3) * BLOCK_VOXELS - HALF
    for row, block in enumerate(blocks):
        for x, y in np.ndindex(BLOCK_VOXELS, BLOCK_VOXELS):
            if all(HOLE[0] <= at < HOLE[1] for at in (block[0] + x, block[1] + y)):
                byte = x * BLOCK_VOXELS + y
                if free:
                    open_air[row, byte] |= surface[row, byte]
                surface[row, byte] = 0
    before, after = (
        np.unpackbits(bits, bitorder="little").astype(bool) for bits in (evidence.surface, surface)
    )
    kept = after[before]
    return with_evidence(
        record,
        surface=surface,
        free=open_air,
        levels=evidence.levels[kept],
        seen_s=np.where(surface.any(axis=1), evidence.seen_s, 0),
        outcomes=evidence.outcomes[kept],
        margins=evidence.margins[kept],
    )


def mesh_of(record: MapRecord, **options: object) -> Mesh:
    with OfflineMap(record) as offline:
        return offline.mesh(((0, 0, -2), (4, 4, 2)), **options)


def area(mesh: Mesh, chosen: NDArray[np.bool_]) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[chosen]], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


GROUND = ground(flat(0.1))


def test_a_hole_that_no_ray_met_is_closed_and_marked() -> None:
    record = with_hole(GROUND)
    mesh = mesh_of(record, fill_m=1.0)
    assert area(mesh, np.ones(len(mesh.faces), np.bool_)) == pytest.approx(16.0)
    assert area(mesh, mesh.filled) == pytest.approx(HOLE_M2, abs=0.2)
    np.testing.assert_allclose(mesh.vertices[:, 2], 0.1, atol=1e-5)
    with OfflineMap(record) as offline:
        centres = mesh.vertices[mesh.faces[mesh.filled]].mean(axis=1)
        middle = centres[np.abs(centres[:, :2] - 2.0).max(axis=1) < 0.7]
        assert (offline.query_sdf(middle).status == Status.UNKNOWN).all()


def test_an_opening_that_rays_passed_stays_open() -> None:
    record = with_hole(GROUND, free=True)
    mesh = mesh_of(record, fill_m=1.0)
    assert not mesh.filled.any()
    plain = mesh_of(record)
    np.testing.assert_array_equal(mesh.faces, plain.faces)


def test_what_does_not_lie_in_line_with_the_seen_surface_is_not_filled() -> None:
    """In the hole the field has a pit."""
    pit = ground(lambda x, y: np.where((x > 1) & (x < 3) & (y > 1) & (y < 3), -0.7, 0.1))
    mesh = mesh_of(with_hole(pit), fill_m=1.0)
    assert area(mesh, mesh.filled) < 1.0


def test_without_filling_it_is_the_mesh_as_ever(tmp_path) -> None:
    record = with_hole(GROUND)
    plain, none = mesh_of(record), mesh_of(record, fill_m=0.0)
    assert plain.filled is None
    assert plain.file_bytes(".ply") == none.file_bytes(".ply")
    assert area(plain, np.ones(len(plain.faces), np.bool_)) == pytest.approx(12.0, abs=0.2)


@pytest.mark.parametrize("fill_m", [-0.1, 6.0, float("nan")])
def test_lengths_that_cannot_be_filled_are_refused(fill_m: float) -> None:
    with pytest.raises(InvalidInputError, match="fill_m = .*use 0 to 5"):
        mesh_of(GROUND, fill_m=fill_m)


def test_of_a_learnt_street_only_unknown_space_beside_seen_surface_is_filled() -> None:
    record, fill_m = settled_epoch(4).record(), 0.7
    bounds = ((-5, -10, -1), (25, 10, 6))
    with OfflineMap(record) as offline:
        plain, mesh = offline.mesh(bounds), offline.mesh(bounds, fill_m=fill_m)
        centres = mesh.vertices[mesh.faces].mean(axis=1)
        holes = centres[mesh.filled]
        status = offline._map.view.status(holes, 0.0)
    assert area(mesh, mesh.filled) > 0.1 * area(mesh, ~mesh.filled)
    steps = holes / record.settings.leaf_m
    amid = (np.abs(steps - np.round(steps)) > 1e-6).all(axis=1)  # on a face, rounding decides
    assert amid.mean() > 0.99
    assert (status[amid] != Status.FREE).all()
    seen = surface_voxels(record)
    _, nearest = cKDTree(seen).query(holes, k=20)
    gaps = np.maximum(np.abs(seen[nearest] - holes[:, None]) - record.settings.leaf_m / 2, 0.0)
    assert np.linalg.norm(gaps, axis=2).min(axis=1).max() <= fill_m
    error = np.abs(world(4).scene.sdf(holes))
    assert (error < 0.1).mean() > 0.9
    was = plain.vertices[plain.faces].mean(axis=1)
    assert len(was) == (~mesh.filled).sum()
    assert cKDTree(was).query(centres[~mesh.filled])[0].max() < 1e-4


def with_edge(quarters: int) -> MapRecord:
    """Ground up to x = 2 m, on which rays ended up to so many quarters of a voxel before that."""
    evidence = GROUND.regions[0].evidence
    blocks = morton.decode(evidence.codes, 3)[:, :1] * BLOCK_VOXELS - HALF
    x = blocks + np.repeat(np.arange(BLOCK_VOXELS), BLOCK_VOXELS**2)
    evidence = masked(evidence, np.packbits(x < EDGE, axis=1, bitorder="little"))
    outermost = seen_voxels(evidence, evidence.surface)[:, 0] == HALF + EDGE - 1
    margins = np.zeros((len(outermost), 6), np.uint8)
    margins[outermost, 3] = quarters
    return with_region(GROUND, evidence=dataclasses.replace(evidence, margins=margins))


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_surface_ends_where_the_last_rays_did(quarters: int) -> None:
    mesh = mesh_of(with_edge(quarters), cell_m=0.02)
    end_m = 0.2 * EDGE - 0.05 * quarters
    assert mesh.vertices[mesh.faces][..., 0].max() == pytest.approx(end_m, abs=0.03)
    assert area(mesh, np.ones(len(mesh.faces), np.bool_)) == pytest.approx(4 * end_m, abs=0.1)


def test_the_rest_of_a_voxel_is_filled_and_marked() -> None:
    mesh = mesh_of(with_edge(3), cell_m=0.02, fill_m=0.3)
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    seen_to_m = 0.2 * EDGE - 0.15
    assert middles[~mesh.filled, 0].max() == pytest.approx(seen_to_m, abs=0.02)
    assert area(mesh, mesh.filled) >= 4 * 0.15 - 0.05
    assert mesh.vertices[mesh.faces][..., 0].max() <= 0.2 * EDGE + 0.3 + 0.02
