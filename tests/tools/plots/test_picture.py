"""Pictures of meshes, read back."""

import dataclasses

import numpy as np
import pytest
from PIL import Image
from support.maps.exact_maps import exact_map, table
from support.maps.map_records import random_record
from triquad_client import Mesh
from triquad_format.mapfile.writer import write_map
from triquad_map.height_scale import HEIGHT_STOPS
from triquad_tools.commands.pack import main
from triquad_tools.plots.mesh_sheet import TOP, Legend, save_mesh_sheet
from triquad_tools.plots.mesh_view import (
    BACKGROUND,
    HEIGHT,
    WIDTH,
    Picture,
    view_along,
)
from triquad_tools.plots.plan import HEIGHTS, Scale

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
EMPTY = np.broadcast_to((255 * BACKGROUND).astype(np.uint8), (HEIGHT, WIDTH, 3))
TEAL, RED = np.array([0.15, 0.6, 0.5]), np.array([1.0, 0.0, 0.0])


def squares(*corners, side_m=1.0):
    """Level squares, each with its corner of smallest x and y at one of ``corners``."""
    vertices = np.concatenate([side_m * SQUARE + corner for corner in corners])
    faces = np.concatenate([SQUARE_FACES + 4 * i for i in range(len(corners))])
    return Mesh(vertices, faces.astype(np.int32))


def ground(width_m, depth_m):
    """Level squares of a metre."""
    return squares(*[(x, y, 0.0) for x in range(width_m) for y in range(depth_m)])


def both(one, other):
    vertices = np.concatenate([one.vertices, other.vertices])
    return Mesh(vertices, np.concatenate([one.faces, other.faces + len(one.vertices)]))


def view_of(mesh):
    return view_along(mesh.vertices, mesh.vertices[mesh.faces])


def rendered(mesh, colour, view, points=()):
    """The pixels of a mesh in one colour, and of red points."""
    picture = Picture(view)
    picture.add_mesh(mesh.vertices, mesh.faces, np.tile(colour, (len(mesh.vertices), 1)))
    if len(points):
        picture.add_points(np.array(points), np.tile(RED, (len(points), 1)))
    return picture.pixels().astype(int)


def read_picture(path):
    """Pixels ``[rows, columns, 3]`` of 0 to 255, as Pillow reads them."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def shown(pixels):
    """``[HEIGHT, WIDTH]``: where the picture within the sheet has something."""
    inside = pixels[TOP : TOP + HEIGHT, :WIDTH]
    return np.abs(inside - EMPTY).max(axis=2) > 8


def near(pixels, colour, within=12):
    """Which pixels have an sRGB colour in [0, 1], all but."""
    return np.abs(pixels - 255 * np.asarray(colour)).max(axis=-1) <= within


# The view


@pytest.mark.parametrize("mesh", [ground(40, 3), ground(3, 40), ground(12, 12), ground(1, 1)])
def test_the_view_has_all_of_a_map_in_its_picture(mesh):
    view = view_of(mesh)
    column, row, _ = view.project(mesh.vertices).T
    assert min(column.min(), row.min()) >= 0
    assert column.max() <= WIDTH
    assert row.max() <= HEIGHT
    # As near as can be: along one axis it goes from edge to edge, but for a margin.
    assert max(np.ptp(column) / WIDTH, np.ptp(row) / HEIGHT) > 0.9


def test_a_long_map_lies_along_the_picture():
    for mesh in (ground(40, 3), ground(3, 40)):
        column, row, _ = view_of(mesh).project(mesh.vertices).T
        assert np.ptp(column) > 1.5 * np.ptp(row)


def test_what_lies_far_away_is_left_out():
    mesh = ground(20, 20)
    view = view_of(both(mesh, squares((900.0, 0.0, 0.0), side_m=0.5)))
    assert view.height_m < 1.3 * view_of(mesh).height_m
    assert "what lies far away from all else" in view.description


def test_a_metre_is_as_long_everywhere_and_up_is_up():
    view = view_of(ground(12, 12))
    places = np.random.default_rng(0).uniform(-50.0, 50.0, (20, 3))
    for direction in np.eye(3):
        ends = (view.project(places + step * direction) for step in (0.0, 1.0))
        lengths = np.linalg.norm(np.subtract(*ends)[:, :2], axis=1)
        np.testing.assert_allclose(lengths, lengths[0])
    low, high = view.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert high[1] < low[1]
    assert high[0] == pytest.approx(low[0])


# What it shows


def test_nearer_things_hide_farther_ones_and_backs_are_left_out():
    floor, plate = ground(8, 8), squares((1.0, 1.0, 3.0), side_m=6.0)
    view = view_of(floor)
    seen = rendered(both(floor, plate), TEAL, view)
    np.testing.assert_array_equal(seen, rendered(both(plate, floor), TEAL, view))
    ceiling = Mesh(plate.vertices, plate.faces[:, ::-1])  # seen from below
    np.testing.assert_array_equal(rendered(ceiling, TEAL, view), Picture(view).pixels())
    above, below = [[4.0, 4.0, 4.0]], [[4.0, 4.0, 1.0]]
    assert near(rendered(plate, TEAL, view, above), RED).any()
    assert not near(rendered(plate, TEAL, view, below), RED).any()


@pytest.mark.parametrize("beyond", [(False, False), (True, False), (False, True), (True, True)])
def test_the_legend_marks_values_beyond_its_scale(tmp_path, beyond):
    picture = Picture(view_of(ground(3, 3)))
    legend = Legend("map", Scale("height in m", HEIGHTS, 0.0, 1.0), beyond, [""])
    save_mesh_sheet(tmp_path / "sheet.png", picture, legend)
    pixels = read_picture(tmp_path / "sheet.png")
    # The bar ends in an arrow, which has no corners.
    assert near(pixels[153, 1365], BACKGROUND) == beyond[1]
    assert near(pixels[506, 1365], BACKGROUND) == beyond[0]
    assert near(pixels[480, 1377], HEIGHT_STOPS[0], within=24)


# The command


def test_a_picture_of_a_map_has_the_colours_of_its_heights(tmp_path, capsys):
    path, out = tmp_path / "map.triquad", tmp_path / "map.png"
    write_map(exact_map(table(0.1, 1.1, side_m=8.0)), path, feature_dtype="<f4", stamp_ns=10**18)
    assert main([str(path), str(out)]) == 0
    assert "a picture of" in capsys.readouterr().out
    pixels = read_picture(out)
    assert pixels.shape == (900, 1600, 3)
    inside = pixels[TOP : TOP + HEIGHT, :WIDTH]
    low, high = (near(inside, HEIGHT_STOPS[end]).mean() for end in (0, -1))
    assert low > 0.1  # the ground
    assert high > 0.02  # the table
    assert low > 2 * high
    within = shown(pixels)[3:-3, 3:-3]  # the frame
    assert not within[[0, -1]].any()
    assert not within[:, [0, -1]].any()


def test_a_map_with_next_to_nothing_has_a_picture(tmp_path):
    path, out = tmp_path / "map.triquad", tmp_path / "map.png"
    write_map(exact_map(table(0.1, 1.1)), path, feature_dtype="<f4")
    assert main([str(path), str(out), "--crop", "5", "5", "-1", "5.3", "5.3", "1"]) == 0
    assert 0.05 < shown(read_picture(out)).mean() < 0.9


def test_a_map_without_surface_has_no_picture(tmp_path, capsys):
    path, out = tmp_path / "map.triquad", tmp_path / "map.png"
    write_map(random_record(indices=()), path)
    assert main([str(path), str(out)]) == 1
    assert "is not written: no surface was seen" in capsys.readouterr().err
    record = exact_map(table(0.1, 1.1))
    write_map(dataclasses.replace(record, regions=record.regions), path, feature_dtype="<f4")
    assert main([str(path), str(out), "--crop", "5", "5", "2", "6", "6", "3"]) == 1
    assert "in the box of --crop" in capsys.readouterr().err
    assert not out.exists()
