"""Pictures of meshes, read back."""

import dataclasses

import numpy as np
import pytest
from PIL import Image
from support.exact_maps import exact_map, table
from support.map_records import random_record
from triquad_client import Mesh
from triquad_format.mapfile.writer import write_map
from triquad_map.height_scale import HEIGHT_STOPS
from triquad_tools.commands.pack import main
from triquad_tools.plots.framing import framed
from triquad_tools.plots.mesh_sheet import (
    HEIGHT,
    WIDTH,
    ColourBar,
    Heading,
    Legend,
    save_mesh_sheet,
)
from triquad_tools.plots.picture import draw_mesh, outside_notes
from triquad_tools.plots.render import BACKGROUND

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
ASPECT = WIDTH / HEIGHT
EMPTY = np.broadcast_to((255 * BACKGROUND).astype(np.uint8), (HEIGHT, WIDTH, 3))


def squares(*corners, side_m=1.0):
    """Level squares, each with its corner of smallest x and y at one of ``corners``."""
    vertices = np.concatenate([side_m * SQUARE + corner for corner in corners])
    faces = np.concatenate([SQUARE_FACES + 4 * i for i in range(len(corners))])
    return Mesh(vertices, faces)


def ground(width_m, depth_m):
    """Level squares of a metre."""
    places = [(x, y, 0.0) for x in range(width_m) for y in range(depth_m)]
    return squares(*places)


def read_picture(path):
    """Pixels ``[rows, columns, 3]`` of 0 to 255, as Pillow reads them."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def shown(pixels):
    """``[HEIGHT, WIDTH]``: where the picture within the sheet has something."""
    inside = pixels[90 : 90 + HEIGHT, :WIDTH]
    return np.abs(inside - EMPTY).max(axis=2) > 8


def near(pixels, colour, within=12):
    """Which pixels have an sRGB colour in [0, 1], all but."""
    return np.abs(pixels - 255 * np.asarray(colour)).max(axis=-1) <= within


@pytest.mark.parametrize("mesh", [ground(40, 3), ground(3, 40), ground(12, 12), ground(1, 1)])
def test_the_camera_has_all_of_a_map_in_its_picture(mesh):
    view = framed(mesh, ASPECT)
    assert view.outside_share == 0.0
    column, row, _ = view.camera.project(mesh.vertices, WIDTH, HEIGHT).T
    assert column.min() >= 0
    assert column.max() <= WIDTH
    assert row.min() >= 0
    assert row.max() <= HEIGHT
    # As near as can be: along one axis it goes from edge to edge, but for a margin.
    filled = max(np.ptp(column) / WIDTH, np.ptp(row) / HEIGHT)
    assert filled > 0.9
    assert outside_notes(view) == []


def test_a_long_map_lies_along_the_picture():
    for mesh in (ground(40, 3), ground(3, 40)):
        column, row, _ = framed(mesh, ASPECT).camera.project(mesh.vertices, WIDTH, HEIGHT).T
        assert np.ptp(column) > 1.5 * np.ptp(row)


def test_what_lies_far_away_is_left_out_and_told():
    mesh = ground(20, 20)
    far = squares((900.0, 0.0, 0.0), side_m=0.5)
    both = Mesh(
        np.concatenate([mesh.vertices, far.vertices]),
        np.concatenate([mesh.faces, far.faces + len(mesh.vertices)]),
    )
    alone, view = framed(mesh, ASPECT), framed(both, ASPECT)
    assert view.camera.height_m < 1.3 * alone.camera.height_m
    assert view.outside_share == pytest.approx(1 / 401)
    assert outside_notes(view)[0].startswith("beyond the edges: 0.25 % of the faces, up to 8")


def test_a_ceiling_does_not_hide_the_floor(tmp_path):
    floor = ground(10, 10)
    ceiling = Mesh(floor.vertices + [0, 0, 3], floor.faces[:, ::-1])  # seen from below
    both = Mesh(
        np.concatenate([floor.vertices, ceiling.vertices]),
        np.concatenate([floor.faces, ceiling.faces + len(floor.vertices)]),
    )
    draw_mesh(Heading("map 'room'"), both, tmp_path / "room.png")
    pixels = read_picture(tmp_path / "room.png")[90 : 90 + HEIGHT, :WIDTH]
    assert near(pixels, HEIGHT_STOPS[4]).mean() > 0.3  # the middle of its own scale
    assert not near(pixels, HEIGHT_STOPS[-1]).any()


@pytest.mark.parametrize("below", ["", "down to -1 m"])
@pytest.mark.parametrize("above", ["", "up to 2 m"])
def test_the_legend_marks_values_beyond_its_scale(tmp_path, above, below):
    bar = ColourBar("height in m", HEIGHT_STOPS, low=0.0, high=1.0, above=above, below=below)
    save_mesh_sheet(tmp_path / "sheet.png", EMPTY, Legend(Heading("map"), bar))
    pixels = read_picture(tmp_path / "sheet.png")
    # The bar ends in an arrow, which has no corners.
    assert near(pixels[194, 1360], BACKGROUND) == bool(above)
    assert near(pixels[515, 1360], BACKGROUND) == bool(below)
    assert near(pixels[508, 1371], HEIGHT_STOPS[0], within=16)
    words_above, words_below = pixels[158:182, 1350:1600], pixels[530:560, 1350:1600]
    assert (words_above < 128).any() == bool(above)
    assert (words_below < 128).any() == bool(below)


def test_the_legend_tells_heights_beyond_the_scale(tmp_path):
    """A mast of few faces over a plain: its colour is that of the scale's end."""
    plain = ground(30, 30)
    mast = squares((15.0, 15.0, 50.0), side_m=0.5)
    mesh = Mesh(
        np.concatenate([plain.vertices, mast.vertices]),
        np.concatenate([plain.faces, mast.faces + len(plain.vertices)]),
    )
    draw_mesh(Heading("map"), mesh, tmp_path / "mast.png")
    draw_mesh(Heading("map"), ground(30, 30), tmp_path / "plain.png")
    corners = [read_picture(tmp_path / f"{name}.png")[194, 1360] for name in ("mast", "plain")]
    assert [bool(near(corner, BACKGROUND)) for corner in corners] == [True, False]


# The command


def test_a_picture_of_a_map_has_the_colours_of_its_heights(tmp_path, capsys):
    path, out = tmp_path / "map.triquad", tmp_path / "map.png"
    write_map(exact_map(table(0.1, 1.1, side_m=8.0)), path, feature_dtype="<f4", stamp_ns=10**18)
    assert main([str(path), str(out)]) == 0
    assert "a picture of" in capsys.readouterr().out
    pixels = read_picture(out)
    assert pixels.shape == (900, 1600, 3)
    inside = pixels[90 : 90 + HEIGHT, :WIDTH]
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
