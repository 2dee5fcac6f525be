import numpy as np
import pytest
from triquad_tools.plots.camera import ParallelCamera, PerspectiveCamera
from triquad_tools.plots.mesh_normals import vertex_normals
from triquad_tools.plots.raster import rasterise
from triquad_tools.plots.render import BACKGROUND, render_mesh

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
FROM_ABOVE = PerspectiveCamera(np.array([0.0, 0.0, 10.0]), np.array([0.0, 0.0, 0.0]))
FROM_BELOW = PerspectiveCamera(np.array([0.0, 0.0, -10.0]), np.array([0.0, 0.0, 0.0]))
CLAY = np.full((4, 3), 0.6)
RED, GREEN = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])


def _two_squares(first_z: float, second_z: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A red square, then a green one, at two heights."""
    up = np.array([0.0, 0.0, 1.0])
    vertices = np.vstack([SQUARE + first_z * up, SQUARE + second_z * up])
    colours = np.vstack([np.repeat(RED, 4, axis=0), np.repeat(GREEN, 4, axis=0)])
    return vertices, np.vstack([SQUARE_FACES, SQUARE_FACES + 4]), colours


@pytest.mark.parametrize(("heights", "nearest"), [((0.0, 1.0), 1), ((1.0, 0.0), 0)])
def test_nearer_things_hide_farther_ones(heights: tuple[float, float], nearest: int) -> None:
    vertices, faces, colours = _two_squares(*heights)
    picture = render_mesh(vertices, faces, colours, camera=FROM_ABOVE, width=64, height=48)
    assert np.argmax(picture[24, 32]) == nearest
    from_below = render_mesh(vertices, faces, colours, camera=FROM_BELOW, width=64, height=48)
    assert np.argmax(from_below[24, 32]) == 1 - nearest


def test_faces_seen_from_inside_are_darker() -> None:
    front, back = (
        render_mesh(SQUARE, faces, CLAY, camera=FROM_ABOVE, width=64, height=48)[24, 32]
        for faces in (SQUARE_FACES, SQUARE_FACES[:, ::-1])
    )
    assert np.all(back < 0.8 * front)


def test_a_roof_throws_a_shadow() -> None:
    floor = SQUARE * np.array([10.0, 10.0, 1.0])
    vertices = np.vstack([floor, SQUARE + np.array([0.0, 0.0, 3.0])])
    faces = np.vstack([SQUARE_FACES, SQUARE_FACES + 4])
    camera = PerspectiveCamera(np.array([0.0, 0.0, 40.0]), np.array([0.0, 0.0, 0.0]))
    bare = render_mesh(floor, SQUARE_FACES, CLAY, camera=camera, width=96, height=96).astype(int)
    shaded = render_mesh(
        vertices, faces, np.vstack([CLAY, CLAY]), camera=camera, width=96, height=96
    ).astype(int)
    darker = np.any(bare - shaded > 40, axis=2)
    square_m2 = 4.0 * (37.0 / 40.0) ** -2
    metres = 2.0 * 40.0 * np.tan(np.radians(0.5 * camera.view_deg)) / 96
    assert 0.3 < np.sum(darker) * metres**2 / square_m2 < 1.5


def _of_nothing() -> np.ndarray:
    """A picture of no mesh."""
    nothing = np.empty((0, 3))
    return render_mesh(
        nothing, nothing.astype(np.int64), nothing, camera=FROM_ABOVE, width=32, height=16
    )


def test_an_empty_mesh_is_all_background() -> None:
    picture = _of_nothing()
    assert picture.shape == (16, 32, 3)
    assert picture.dtype == np.uint8
    np.testing.assert_allclose(picture, np.broadcast_to(255 * BACKGROUND, picture.shape), atol=1)


def test_things_behind_the_eye_are_not_drawn() -> None:
    away = PerspectiveCamera(np.array([0.0, 0.0, 10.0]), np.array([0.0, 0.0, 20.0]))
    seen = render_mesh(SQUARE, SQUARE_FACES, CLAY, camera=away, width=32, height=16)
    np.testing.assert_array_equal(seen, _of_nothing())


EYE = np.array([3.0, -8.0, 6.0])
ASLANT = [
    PerspectiveCamera(EYE, np.array([0.5, 0.2, 0.0])),
    ParallelCamera(-EYE, np.array([0.5, 0.2, 0.0]), height_m=6.0),
]


@pytest.mark.parametrize("camera", ASLANT)
def test_projection_and_its_inverse_agree(camera) -> None:
    nearness = np.random.default_rng(0).uniform(0.05, 0.5, (9, 16))
    places = camera.unproject(nearness)
    seen = camera.project(places.reshape(-1, 3), 16, 9).reshape(9, 16, 3)
    np.testing.assert_allclose(seen[..., 2], nearness)
    np.testing.assert_allclose(seen[4, :, 0], np.arange(16) + 0.5)
    np.testing.assert_allclose(seen[:, 7, 1], np.arange(9) + 0.5)


@pytest.mark.parametrize("camera", ASLANT)
def test_what_is_nearer_to_the_eye_hides_the_rest(camera) -> None:
    ahead = camera.axes[2]
    near, far = camera.project(camera.target + [-0.5 * ahead, 0.5 * ahead], 16, 9)
    np.testing.assert_allclose(near[:2], far[:2])
    assert near[2] > far[2]
    assert camera.relative_depth(near[2]) < camera.relative_depth(far[2])


def test_a_metre_is_as_long_everywhere_in_parallel_projection() -> None:
    camera = ASLANT[1]
    places = np.random.default_rng(0).uniform(-50.0, 50.0, (20, 3))
    for direction in np.eye(3):
        ends = (camera.project(places + step * direction, 160, 90) for step in (0.0, 1.0))
        lengths = np.linalg.norm(np.subtract(*ends)[:, :2], axis=1)
        np.testing.assert_allclose(lengths, lengths[0])


def test_level_ground_in_the_sun_has_its_own_colour() -> None:
    colours = np.tile([[0.15, 0.6, 0.5]], (4, 1))
    for camera in ASLANT:
        picture = render_mesh(5 * SQUARE, SQUARE_FACES, colours, camera=camera, width=64, height=48)
        np.testing.assert_allclose(picture[24, 32], 255 * colours[0], atol=4)


def test_right_and_up_in_the_picture_are_right_and_up_in_the_world() -> None:
    camera = PerspectiveCamera(np.array([0.0, -10.0, 0.0]), np.array([0.0, 0.0, 0.0]))
    column, row, _ = camera.project(np.array([[1.0, 0.0, 1.0]]), 100, 100)[0]
    assert column > 50.0  # looking along +y, +x is to the right
    assert row < 50.0


def test_rasteriser_covers_each_pixel_of_a_square_once() -> None:
    corners = np.array([[2.0, 1.0, 1.0], [6.0, 1.0, 1.0], [6.0, 4.0, 1.0], [2.0, 4.0, 1.0]])
    for faces in (SQUARE_FACES, SQUARE_FACES[:, ::-1]):
        raster = rasterise(corners, faces, 8, 6)
        covered = np.zeros((6, 8), bool)
        covered[1:4, 2:6] = True
        np.testing.assert_array_equal(raster.faces >= 0, covered)
        np.testing.assert_allclose(raster.weights[covered].sum(axis=1), 1.0, atol=1e-6)


def test_faces_that_are_not_finite_are_left_out() -> None:
    corners = np.array([[0.0, 0.0, 1.0], [np.nan, 0.0, 1.0], [8.0, 8.0, 1.0]])
    assert np.all(rasterise(corners, np.array([[0, 1, 2]]), 8, 8).faces == -1)


def test_normals_of_vertices_are_those_around_them() -> None:
    normals = vertex_normals(SQUARE, SQUARE_FACES.astype(np.int32))
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (4, 1)))
