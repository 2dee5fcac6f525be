"""How finely what is drawn: levels of detail, and meshes thinned beyond them."""

import io

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from skimage.measure import marching_cubes
from support.servers import SMALL, learn, running_service
from triquad_client import connect
from triquad_tools.plots.camera import view_axes
from triquad_tools.viewer.mesh.detail import Viewpoint, wanted_levels
from triquad_tools.viewer.mesh.near_tiles import NearTiles
from triquad_tools.viewer.mesh.overview_camera import view_of
from triquad_tools.viewer.mesh.thinning import thinned
from triquad_tools.viewer.page.tone_mapping import toned, untoned
from triquad_tools.viewer.page.unlit_glb import Triangles, unlit_glb
from triquad_tools.viewer.sources.live_source import LiveSource
from triquad_tools.viewer.sources.map_source import COARSEST

CELLS_M = np.array([0.1, 0.2, 0.4, 0.8, 1.6])
SIDE_M = 25.6


@given(
    eye=st.tuples(*[st.floats(-500, 500)] * 3),
    corner=st.tuples(*[st.floats(-500, 500)] * 3),
    pixels=st.floats(1, 20),
)
def test_cells_are_as_coarse_as_their_pixels_allow(
    eye: tuple[float, ...], corner: tuple[float, ...], pixels: float
) -> None:
    viewpoint = Viewpoint(np.array(eye), 0.002)
    corners = np.array([corner])
    level = wanted_levels(corners, SIDE_M, CELLS_M, viewpoint=viewpoint, pixels=pixels)[0]
    outside = np.maximum(0, np.maximum(corners[0] - eye, eye - corners[0] - SIDE_M))
    pixel_m = 0.002 * np.linalg.norm(outside)
    assert level == 0 or CELLS_M[level] <= pixels * pixel_m * (1 + 1e-9)
    assert level == len(CELLS_M) - 1 or CELLS_M[level + 1] > pixels * pixel_m * (1 - 1e-9)


def test_tiles_above_each_other_have_the_finest_of_their_levels() -> None:
    viewpoint = Viewpoint(np.array([-100.0, 0.0, 20.0]), 0.002)
    below, above, farther = (0.0, 0.0, -SIDE_M), (0.0, 0.0, 0.0), (2000.0, 0.0, 0.0)

    def levels(*corners: tuple[float, ...]) -> list[int]:
        found = wanted_levels(np.array(corners), SIDE_M, CELLS_M, viewpoint=viewpoint, pixels=1.99)
        return found.tolist()

    alone = [levels(corner)[0] for corner in (below, above, farther)]
    assert alone[0] > alone[1] < alone[2]
    assert levels(below, farther, above) == [alone[1], alone[2], alone[1]]


def test_a_thinned_mesh_is_smaller_and_stays_where_it_was() -> None:
    ball = trimesh.creation.icosphere(5, 3.0)
    middle = np.array([12.0, 12.0, 12.0])
    mesh = Triangles((middle + ball.vertices).astype(np.float32), ball.faces.astype(np.int32))
    fewer = thinned(mesh, 0.5, SIDE_M)
    assert 100 < len(fewer.faces) < 0.2 * len(ball.faces)
    radii = np.linalg.norm(fewer.vertices - middle, axis=1)
    assert (np.abs(radii - 3.0) < 0.1).all()
    a, b, c = fewer.faces.T
    assert not ((a == b) | (b == c) | (a == c)).any()
    corners = fewer.vertices[fewer.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = (across * (corners.mean(axis=1) - middle)).sum(axis=1) > 0
    assert outwards.mean() > 0.99, "faces go on to look outwards"


def test_tiles_that_are_thinned_alike_meet_without_cracks() -> None:
    """A wavy ground across the side at x = 0 of two tiles."""
    x, y = np.meshgrid(np.arange(65) * 0.1, np.arange(65) * 0.1, indexing="ij")
    rows = np.arange(65 * 65).reshape(65, 65)
    a, b, c, d = (rows[i : i + 64, j : j + 64].ravel() for i, j in np.ndindex(2, 2))
    faces = np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)]).astype(np.int32)
    sides = []
    for shift in (0.0, -6.4):  # of the second tile, which lies at smaller x
        z = 1.0 + 0.5 * np.sin(3 * (x + shift)) * np.cos(2 * y)
        vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
        fewer = thinned(Triangles(vertices, faces), 0.8, 6.4)
        assert len(fewer.faces) < 0.1 * len(faces)
        at_m = -shift
        sides.append(fewer.vertices[np.abs(fewer.vertices[:, 0] - at_m) < 1e-4][:, 1:])
    assert len(sides[0]) > 8
    np.testing.assert_allclose(*(np.sort(side, axis=0) for side in sides), atol=1e-4)


def test_a_ground_in_the_side_between_two_tiles_stays_whole() -> None:
    """Waves of 3 mm around z = 0, where one tile lies on another."""
    side_m, at_m = 6.4, np.arange(65) * 0.1
    x, y, z = np.meshgrid(at_m, at_m, at_m, indexing="ij")
    ground_m = 0.003 * np.sin(5 * x + 0.3) * np.cos(7 * y + 0.2)
    covered_m2 = 0.0
    for least_z_m in (0.0, -side_m):
        vertices, faces, *_ = marching_cubes(z + least_z_m - ground_m, 0.0, spacing=(0.1,) * 3)
        fewer = thinned(Triangles(vertices, faces), 0.4, side_m)
        a, b, c = (fewer.vertices[fewer.faces[:, corner], :2] for corner in range(3))
        covered_m2 += abs(float(np.linalg.det(np.stack([b - a, c - a], axis=1)).sum())) / 2
    assert covered_m2 == pytest.approx(side_m**2, rel=0.005)


def test_nothing_thinned_is_nothing() -> None:
    none = thinned(Triangles(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), 0.5, SIDE_M)
    assert none.vertices.shape == none.faces.shape == (0, 3)


def test_a_glb_holds_the_mesh_and_its_colours() -> None:
    ball = trimesh.creation.icosphere(2, 3.0)
    colours = np.random.default_rng(0).uniform(0.0, 0.95, (len(ball.vertices), 3))
    vertices, faces = ball.vertices.astype(np.float32), ball.faces.astype(np.int32)
    data = unlit_glb(Triangles(vertices, faces), colours)
    (read,) = trimesh.load(io.BytesIO(data), file_type="glb", process=False).geometry.values()
    np.testing.assert_array_equal(read.vertices.astype(np.float32), vertices)
    np.testing.assert_array_equal(read.faces, faces)
    shown = toned(read.visual.vertex_attributes["color"][:, :3])
    np.testing.assert_allclose(shown, colours, atol=1e-4)


def test_white_stays_nearly_white() -> None:
    assert toned(untoned(np.ones((1, 3)))).min() > 0.95


@pytest.mark.parametrize("level", range(COARSEST))
def test_near_tiles_are_those_of_the_server(level: int) -> None:
    with running_service(SMALL) as endpoint, connect(endpoint) as client:
        learn(client)
        client.settle()
        near = NearTiles(LiveSource(client, endpoint), level)
        roots = [(0, 0, 0), (-1, -1, -1)]
        near.move(roots)
        for _ in range(1000):
            near.refresh()
            if near.loaded:
                break
        assert set(roots) <= near.ready
        found = dict(near.within((0, 0, 0)))
        with client.watch_mesh(level=level) as watch:
            watch.catch_up()
            count = 1 << (COARSEST - level)
            wanted = {
                index: tile.version
                for index, tile in watch.tiles.items()
                if all(0 <= place < count for place in index)
            }
        assert wanted
        assert {index: tile.version for index, tile in found.items()} == wanted
        near.move([(40, 40, 40)])
        assert not near.ready & set(roots)
        near.close()


@given(
    corner=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
    side=st.tuples(*[st.floats(0.5, 500)] * 3),
    aspect=st.floats(0.3, 3),
)
def test_all_of_a_map_is_in_view(
    corner: tuple[float, ...], side: tuple[float, ...], aspect: float
) -> None:
    """98 of 100 points of a box are in the picture, and they fill a good part of it."""
    points = np.random.default_rng(1).uniform(size=(500, 3)) * side + corner
    view = view_of(points, aspect)
    right, down, ahead = ((points - view.eye) @ view_axes(view.target - view.eye).T).T
    assert (ahead > 0).mean() > 0.98
    height = np.tan(np.radians(25)) * ahead
    outmost = np.maximum(np.abs(right) / aspect, np.abs(down)) / height
    assert (outmost < 1).mean() > 0.98
    assert np.percentile(outmost, 99) > 0.5
