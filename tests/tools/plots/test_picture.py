"""Pictures of meshes, read back."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from support.maps.exact_maps import exact_map, table
from support.maps.map_records import random_record
from triquad_client import Mesh
from triquad_format.mapfile.writer import write_map
from triquad_map.height_scale import HEIGHT_STOPS
from triquad_tools.commands.pack import main
from triquad_tools.plots.picture import (
    BACKGROUND,
    HEIGHT,
    TOP,
    WIDTH,
    draw_faces,
    draw_mesh,
    view_along,
)

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
EMPTY = np.broadcast_to(np.round(255 * np.array(BACKGROUND)).astype(np.uint8), (HEIGHT, WIDTH, 3))
TEAL = np.array([0.15, 0.6, 0.5])


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


def drawn(mesh, colour=TEAL, view=None):
    """The axes of a picture of a mesh in one colour."""
    figure = Figure((WIDTH / 100, HEIGHT / 100), 100, facecolor=BACKGROUND)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    colours = np.tile(colour, (len(mesh.vertices), 1))
    draw_faces(axes, view_of(mesh) if view is None else view, mesh.vertices, mesh.faces, colours)
    return axes


def in_picture(mesh, of=None):
    """Column and row, from below, of the vertices of a mesh in its picture, or that of another."""
    of = of or mesh
    at = mesh.vertices @ view_of(of).T
    return drawn(of).transData.transform(at[:, :2] * [1, -1]).T


def rendered(mesh, colour=TEAL, view=None):
    """The pixels of a mesh in one colour."""
    canvas = FigureCanvasAgg(drawn(mesh, colour, view).figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


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
    column, row = in_picture(mesh)
    assert min(column.min(), row.min()) >= 0
    assert column.max() <= WIDTH
    assert row.max() <= HEIGHT
    # As near as can be: along one axis it goes from edge to edge, but for a margin.
    assert max(np.ptp(column) / WIDTH, np.ptp(row) / HEIGHT) > 0.9


def test_a_long_map_lies_along_the_picture():
    for mesh in (ground(40, 3), ground(3, 40)):
        column, row = in_picture(mesh)
        assert np.ptp(column) > 1.5 * np.ptp(row)


def test_what_lies_far_away_is_left_out():
    mesh = ground(20, 20)
    widths = [
        np.ptp(drawn(shown).get_xlim())
        for shown in (mesh, both(mesh, squares((900.0, 0.0, 0.0), side_m=0.5)))
    ]
    assert widths[1] < 1.3 * widths[0]


def test_up_is_up():
    mast = Mesh(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([[0, 1, 1]], np.int32))
    column, row = in_picture(mast, of=ground(12, 12))
    assert row[1] > row[0]
    assert column[1] == pytest.approx(column[0])


# What it shows


def test_level_ground_has_its_own_colour_and_slopes_another_brightness():
    level = ground(4, 4)
    assert near(rendered(level)[HEIGHT // 2, WIDTH // 2], TEAL, within=3)
    pixels = []
    for slope in (0.7, -0.7):
        rise = np.outer(slope * level.vertices[:, 1], [0, 0, 1])
        tilted = Mesh(level.vertices + rise, level.faces)
        pixels.append(rendered(tilted)[HEIGHT // 2, WIDTH // 2])
        assert np.argmax(pixels[-1]) == np.argmax(TEAL)
    assert np.ptp(pixels, axis=0).max() > 4


def test_nearer_things_hide_farther_ones_and_backs_are_left_out():
    floor, plate = ground(8, 8), squares((1.0, 1.0, 3.0), side_m=6.0)
    view = view_of(floor)
    seen = rendered(both(floor, plate), view=view)
    np.testing.assert_array_equal(seen, rendered(both(plate, floor), view=view))
    ceiling = Mesh(plate.vertices, plate.faces[:, ::-1])  # seen from below
    np.testing.assert_array_equal(rendered(ceiling, view=view), EMPTY)


def test_the_legend_tells_heights_beyond_the_scale(tmp_path):
    """A mast of few faces over a plain: its colour is that of the scale's end."""
    mast = both(ground(30, 30), squares((15.0, 15.0, 50.0), side_m=0.5))
    draw_mesh("map", mast, tmp_path / "mast.png")
    draw_mesh("map", ground(30, 30), tmp_path / "plain.png")
    shown = [read_picture(tmp_path / f"{name}.png") for name in ("mast", "plain")]
    # The bar ends in an arrow, which has no corners.
    assert [bool(near(pixels[153, 1365], BACKGROUND)) for pixels in shown] == [True, False]
    assert not any(near(pixels[506, 1365], BACKGROUND) for pixels in shown)
    assert near(shown[0][480, 1377], HEIGHT_STOPS[0], within=24)


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


def test_faces_that_were_not_seen_are_pale(tmp_path):
    mesh = ground(8, 4)
    filled = mesh.vertices[mesh.faces[:, 0], 0] >= 4
    pictures = []
    for number, shown_as in enumerate((None, filled)):
        draw_mesh("", replace(mesh, filled=shown_as), tmp_path / f"{number}.png")
        pictures.append(read_picture(tmp_path / f"{number}.png"))
    seen, continued = pictures
    changed = (seen != continued).any(axis=-1)
    changed[: TOP + 1] = changed[TOP + HEIGHT :] = False  # what is written there
    assert 0.4 < changed.sum() / shown(seen).sum() < 0.6
    pale = 0.4 * seen[changed] + 0.6 * 255 * np.array(BACKGROUND)
    assert np.quantile(np.abs(continued[changed] - pale), 0.95) < 12


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
    write_map(exact_map(table(0.1, 1.1)), path, feature_dtype="<f4")
    assert main([str(path), str(out), "--crop", "5", "5", "2", "6", "6", "3"]) == 1
    assert "in the box of --crop" in capsys.readouterr().err
    assert not out.exists()
