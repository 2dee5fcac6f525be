import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from skimage import measure
from triquad_map.mesh.marching_cubes import Crossings

SIDE = 12


def cells(side: int = SIDE) -> NDArray[np.int64]:
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)


def lattice(side: int = SIDE) -> NDArray[np.float64]:
    return np.stack(np.meshgrid(*[np.arange(side + 1.0)] * 3, indexing="ij"), -1)


def positions(found: Crossings) -> NDArray[np.float64]:
    return found.points + np.eye(3)[found.axes] * found.fractions[:, None]


def open_edges(faces: NDArray[np.int32]) -> int:
    """Edges with more faces on one side than on the other."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forwards = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    _, edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge.ravel(), forwards)))


def test_a_ball_is_met_where_it_is_and_faces_look_outwards() -> None:
    centre, radius = np.array([6.2, 5.9, 6.1]), 4.3
    volume = (np.linalg.norm(lattice() - centre, axis=-1) - radius).astype(np.float32)
    found = Crossings(cells(), volume)
    places = positions(found)
    np.testing.assert_allclose(np.linalg.norm(places - centre, axis=1), radius, atol=0.05)
    corners = places[found.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * (corners.mean(axis=1) - centre)).sum(axis=1) > 0).all()
    assert open_edges(found.faces) == 0
    # Euler: a closed surface without handles.
    assert len(places) - 1.5 * len(found.faces) + len(found.faces) == 2


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.5, 0.9]))
def test_any_surface_is_closed(seed: int, solid: float) -> None:
    rng = np.random.default_rng(seed)
    volume = np.ones((SIDE + 1,) * 3, np.float32)
    inner = rng.uniform(0.01, 1, (SIDE - 1,) * 3)
    volume[1:-1, 1:-1, 1:-1] = np.where(rng.random(inner.shape) < solid, -inner, inner)
    found = Crossings(cells(), volume)
    assert len(found.faces) > 0
    assert open_edges(found.faces) == 0


def test_what_happens_on_a_face_depends_on_its_corners_alone() -> None:
    """Cells meshed one by one and all at once have the same triangles."""
    volume = np.random.default_rng(2).normal(size=(5, 5, 5)).astype(np.float32)
    whole = Crossings(cells(4), volume)
    apart = [positions(found)[found.faces] for found in each_cell(volume)]
    np.testing.assert_array_equal(np.concatenate(apart), positions(whole)[whole.faces])


def smooth(seed: int, sigma: float) -> NDArray[np.float32]:
    """A random volume without detail smaller than ``sigma`` cells, more or less."""
    noise = np.random.default_rng(seed).normal(size=(SIDE + 1,) * 3)
    volume = gaussian_filter(noise, sigma)
    return (volume / volume.std()).astype(np.float32)


def ambiguous_faces(volume: NDArray[np.float32]) -> int:
    """Faces of cells whose solid corners face each other across the face: tables differ there."""
    count = 0
    for axis in range(3):
        solid = np.moveaxis(volume <= 0, axis, 0)
        a, b = solid[:, :-1, :-1], solid[:, 1:, :-1]
        c, d = solid[:, 1:, 1:], solid[:, :-1, 1:]
        count += np.count_nonzero((a == c) & (b == d) & (a != b))
    return count


@pytest.mark.parametrize("sigma", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("seed", range(10))
def test_vertices_are_those_of_scikit_image(seed: int, sigma: float) -> None:
    volume = smooth(seed, sigma)
    places = positions(Crossings(cells(), volume))
    theirs, _, _, _ = measure.marching_cubes(volume, 0.0, method="lorensen")
    assert len(places) == len(theirs) > 0
    far, partner = cKDTree(theirs).query(places)
    assert len(np.unique(partner)) == len(theirs)
    np.testing.assert_allclose(far, 0, atol=1e-5)


def test_faces_are_those_of_scikit_image_where_no_face_of_a_cell_is_ambiguous() -> None:
    volumes = [smooth(seed, 3.0) for seed in range(60)]
    clear = [volume for volume in volumes if not ambiguous_faces(volume)]
    assert len(clear) > 10
    for volume in clear:
        found = Crossings(cells(), volume)
        vertices, faces, _, _ = measure.marching_cubes(volume, 0.0, method="lorensen")
        assert len(found.faces) == len(faces) > 0
        # Loops of more than three edges need not be flat, and may be filled in other ways.
        area = measure.mesh_surface_area(positions(found), found.faces)
        assert area == pytest.approx(measure.mesh_surface_area(vertices, faces), rel=2e-3)


def each_cell(volume: NDArray[np.float32]) -> list[Crossings]:
    return [Crossings(cell[None], volume) for cell in cells(4)]


def test_cells_with_unknown_corners_are_empty() -> None:
    volume = np.random.default_rng(3).normal(size=(3, 3, 3)).astype(np.float32)
    volume[1, 1, 1] = np.nan
    assert len(Crossings(cells(2), volume).faces) == 0
