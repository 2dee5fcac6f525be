"""What slices, borders of unknown space and paths say, against the map that they are of."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from support.exact_maps import SEEN_M, exact_map, flat, table
from triquad_client import OfflineMap, RefusedError, Status
from triquad_tools.plots.plan import UNKNOWN
from triquad_tools.viewer.asking.contours import contour_step, contours, numbers
from triquad_tools.viewer.asking.distance_scale import distance_colours
from triquad_tools.viewer.asking.path_check import ask_path, in_pieces
from triquad_tools.viewer.asking.path_drawing import piece_colours
from triquad_tools.viewer.asking.path_probe import path_html
from triquad_tools.viewer.asking.questions import in_small_parts
from triquad_tools.viewer.asking.slice_plane import SlicePlane, ask_slice
from triquad_tools.viewer.asking.tube import arrow, tube_mesh
from triquad_tools.viewer.asking.unknown_boundary import (
    CellBox,
    Faces,
    ask_boundary,
    border_faces,
    face_triangles,
)
from triquad_tools.viewer.page.focus import Focus

GROUND_M = 0.1  # in the middle of a voxel
FOCUS = Focus(np.array([0.3, -0.4, 1.2]), 10.0, 16.0)
GREY = tuple(round(255 * part) for part in to_rgb(UNKNOWN))


@pytest.fixture(scope="module")
def ground() -> Iterator[OfflineMap]:
    """Flat ground, free up to 2 m above it, seen within 10 m."""
    with OfflineMap(exact_map(flat(GROUND_M))) as opened:
        yield opened


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slice_has_what_the_map_answers_there(ground: OfflineMap, axis: int) -> None:
    plane = SlicePlane.around(FOCUS, axis, 0.9)
    answer = ask_slice(ground, plane, 3.0)
    rng = np.random.default_rng(axis)
    rows, columns = rng.integers(0, plane.rows, 50), rng.integers(0, plane.columns, 50)
    places = plane.places(columns.astype(float), rows.astype(float))
    np.testing.assert_array_equal(places[:, axis], 0.9)
    asked = ground.query_distance(places, 3.0)
    # Points travel in single precision, from another origin.
    np.testing.assert_allclose(answer.distance_m[rows, columns], asked.distance_m, atol=1e-4)
    np.testing.assert_array_equal(answer.known[rows, columns], asked.status != Status.UNKNOWN)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slice_is_drawn_where_it_is(axis: int) -> None:
    plane = SlicePlane.around(FOCUS, axis, 0.9)
    assert np.linalg.det(plane.axes) == pytest.approx(1.0)
    width, height = plane.size_m
    corner = plane.middle() + plane.axes @ [-0.5 * width, -0.5 * height, 0.0]
    least = plane.places(np.array([-0.5]), np.array([-0.5]))[0]
    np.testing.assert_allclose(corner, least, atol=1e-9)


def test_lines_lie_at_their_distances(ground: OfflineMap) -> None:
    answer = ask_slice(ground, SlicePlane.around(FOCUS, 1, 0.0), 3.0)
    lines = contours(answer, 3.0)
    assert {line.level_m for line in lines} >= {0.0, 0.5, 1.0, 1.5}
    for line in lines:
        assert np.abs(line.points[:, 2] - GROUND_M - line.level_m).max() < 0.05
        assert np.abs(line.points[:, 0]).max() < SEEN_M
    beside = numbers(lines, answer.plane.size_m[0])
    assert {number.level_m for number in beside} >= {0.5, 1.0}


def test_unknown_space_has_no_line_and_is_grey(ground: OfflineMap) -> None:
    answer = ask_slice(ground, SlicePlane.around(FOCUS, 2, 5.0), 3.0)
    assert not answer.known.any()
    assert contours(answer, 3.0) == []
    colours = distance_colours(answer.distance_m, answer.known, 3.0)
    assert {tuple(colour) for colour in colours.reshape(-1, 3).tolist()} == {GREY}


@given(st.floats(0.2, 50.0))
def test_steps_from_line_to_line_are_round(most_m: float) -> None:
    step_m = contour_step(most_m)
    assert f"{step_m:.0e}"[0] in "125"
    assert 3 < most_m / step_m < 12


@given(st.integers(0, 2**32 - 1))
def test_borders_lie_between_free_and_unknown_cells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    status = rng.integers(0, 3, rng.integers(1, 5, 3)).astype(np.uint8)
    found = border_faces(status)
    pairs = set(
        zip(map(tuple, found.cells.tolist()), map(tuple, found.steps.tolist()), strict=True)
    )
    expected = set()
    for cell in np.ndindex(*status.shape):
        for step in [*np.eye(3, dtype=int), *-np.eye(3, dtype=int)]:
            beyond = np.array(cell) + step
            inside = (beyond >= 0).all() and (beyond < status.shape).all()
            if inside and (status[cell], status[tuple(beyond)]) == (Status.FREE, Status.UNKNOWN):
                expected.add((cell, tuple(step.tolist())))
    assert pairs == expected


def test_faces_are_seen_from_the_free_cell() -> None:
    steps = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.int32)
    cells = np.full((6, 3), 4, np.int32)
    vertices, rows = face_triangles(Faces(cells, steps))
    first, second, third = (vertices[rows[:, corner]] for corner in range(3))
    normals = np.cross(second - first, third - first)
    towards_cell = 4.5 - (first + second + third) / 3
    assert ((normals * towards_cell).sum(axis=1) > 0).all()
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(12.0)


def test_ground_is_no_border_of_unknown_space_however_coarse_the_cells(ground: OfflineMap) -> None:
    box = CellBox.around(Focus(np.array([0.1, 0.1, 0.1]), 60.0, 64.0), 0.2)
    assert box.cell_m == 0.75
    faces = ask_boundary(ground, box).faces
    middles = box.places(faces.cells + 0.5 + 0.5 * faces.steps)
    inside = np.abs(middles[:, :2]).max(axis=1) < SEEN_M - box.cell_m
    assert inside.any()
    # All that is seen lies below the sky, and on the ground.
    assert (faces.steps[inside] == [0, 0, 1]).all()


def test_a_path_is_blocked_where_the_map_says(ground: OfflineMap) -> None:
    points = np.array([[-3.0, 0.0, 1.0], [3.0, 0.0, 1.0], [3.0, 3.0, -1.0]])
    answer = ask_path(ground, points, 0.25)
    whole = ground.query_polyline(points, 0.25, 1.0)
    assert answer.whole == whole
    assert whole.blocked
    np.testing.assert_allclose(answer.at(whole.contact_m)[2], GROUND_M + 0.25, atol=0.1)
    assert f"at {whole.contact_m:.2f} m" in path_html(list(points), answer)
    lengths = np.linalg.norm(np.diff(answer.cuts, axis=0), axis=1)
    assert lengths.sum() == pytest.approx(whole.length_m, abs=1e-4)
    reached = np.cumsum(lengths)
    assert not answer.pieces.blocked[reached < whole.contact_m - 0.1].any()
    first = int(answer.pieces.blocked.argmax())
    assert reached[first] == pytest.approx(whole.contact_m, abs=0.3)
    colours = piece_colours(answer)
    assert len({tuple(colour) for colour in colours[answer.pieces.blocked].tolist()}) == 1


def test_large_robots_are_answered_for(ground: OfflineMap) -> None:
    answer = ask_path(ground, np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]), radius_m=50.0)
    assert answer.whole.blocked


def test_unknown_space_on_a_path_is_grey_and_named(ground: OfflineMap) -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 4.0]])
    answer = ask_path(ground, points, 0.1)
    whole = answer.whole
    assert not whole.blocked
    assert f"from {whole.unknown_contact_m:.2f} m" in path_html(list(points), answer)
    assert tuple(piece_colours(answer)[-1]) == GREY
    assert tuple(piece_colours(answer)[0]) != GREY


def test_a_path_over_a_table_is_free() -> None:
    with OfflineMap(exact_map(table(0.1, 0.7))) as opened:
        points = np.array([[-4.0, 0.0, 1.3], [4.0, 0.0, 1.3]])
        answer = ask_path(opened, points, 0.3)
    assert "all along, with radius 0.3 m" in path_html(list(points), answer)
    assert answer.pieces.clearance_m.min() == pytest.approx(0.6, abs=0.05)
    assert answer.pieces.clearance_m.max() > 0.95


def test_a_path_is_cut_evenly_and_keeps_its_corners() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 400, 0]])
    cuts = in_pieces(points)
    assert len(cuts) < 410
    for corner in points:
        assert (np.linalg.norm(cuts - corner, axis=1) < 1e-9).any()


@pytest.mark.parametrize("along", [[0.0, 0, 2], [3.0, 0, 0], [-1.0, 1, 0.2]])
def test_tubes_are_seen_from_outside(along: list[float]) -> None:
    tube = arrow(np.zeros(3), np.array(along), 0.1, np.ones(3))
    vertices, rows = tube_mesh(tube.points[:2], tube.radii_m[:2])
    first, second, third = (vertices[rows[:, corner]].astype(float) for corner in range(3))
    normals = np.cross(second - first, third - first)
    middle = (first + second + third) / 3
    ahead = np.array(along) / np.linalg.norm(along)
    outwards = middle - (middle @ ahead)[:, None] * ahead
    assert ((normals * outwards).sum(axis=1) > 0).all()


def test_parts_are_of_one_epoch_and_asked_again_once_it_is_gone(ground: OfflineMap) -> None:
    asked: list[tuple[int, int | None]] = []

    def ask(part: slice, epoch: int | None) -> OfflineMap:
        asked.append((part.start, epoch))
        if len(asked) == 2:
            raise RefusedError("epoch_gone", "let go of")
        return ground

    assert len(in_small_parts(ask, 25, 10)) == 3
    assert asked == [(0, None), (10, 1), (0, None), (10, 1), (20, 1)]
