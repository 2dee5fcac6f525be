import numpy as np
import pytest
from PIL import Image
from support.checkpoint_folder import FIRST, SECOND, write_checkpoints
from support.exact_maps import SEEN_M, exact_map, flat, table
from support.map_records import random_record
from triquad_format.mapfile.mapfile import read_map_file, write_map
from triquad_tools.commands.inspect import main
from triquad_tools.mapfiles.seen_space import seen_columns, surface_columns
from triquad_tools.plots.change_ages import latest_epochs
from triquad_tools.plots.colour_scale import AGE, HEAT, HEIGHT, ColourScale, rgb
from triquad_tools.plots.plan_grid import PlanGrid
from triquad_tools.plots.plan_sheet import Panel, Swatch, draw_sheet
from triquad_tools.plots.sample_errors import sample_errors

RED, WHITE = (255, 0, 0), (255, 255, 255)
ADDED, GONE, NOT_SEEN = rgb("#0a5fa8"), rgb("#d9480f"), rgb("#f4cfa0")


def pixels_of(picture, colour):
    """Rows and columns ``[N, 2]`` of a picture's pixels of a colour."""
    return np.argwhere((np.asarray(picture) == colour).all(axis=-1))


def read_picture(path):
    with Image.open(path) as picture:
        assert picture.mode == "RGB"
        return np.asarray(picture)


# Grids


def test_a_grid_holds_its_points_in_cells_of_whole_leaves():
    rng = np.random.default_rng(0)
    for size_m, cell_m in ((30.0, 0.2), (200.0, 0.2), (300.0, 0.4), (5000.0, 6.4)):
        points = rng.uniform(-0.5, 0.5, (1000, 2)) * [size_m, size_m / 10] + [7.0, -1000.0]
        grid = PlanGrid.around(points, 0.2)
        assert grid.cell_m == pytest.approx(cell_m)
        np.testing.assert_allclose(grid.low_m / grid.cell_m, np.round(grid.low_m / grid.cell_m))
        assert (points >= grid.low_m).all()
        assert (points <= grid.high_m).all()
        assert grid.columns <= 1200
        assert grid.rows >= 0.4 * grid.columns
        assert grid.marked(points).sum() <= 1000


def test_cells_are_where_their_points_are():
    grid = PlanGrid(np.array([-1.0, -2.0]), 0.5, rows=8, columns=4)
    points = np.array([[-0.9, -1.9], [0.9, 1.9], [0.9, 1.8], [5.0, 0.0]])
    marked = grid.marked(points)
    assert marked[7, 0]  # smallest x and y: below and left
    assert marked[0, 3]
    assert marked.sum() == 2  # one lies outside
    values = np.array([1.0, 2.0, 4.0, 8.0])
    assert grid.highest(points, values)[0, 3] == 4.0
    assert grid.mean(points, values)[0, 3] == 3.0
    assert np.isnan(grid.highest(points, values)[1, 1])
    assert np.isnan(grid.mean(points, values)[1, 1])


def test_a_window_covers_the_cells_between_its_corners():
    grid = PlanGrid(np.array([-1.0, -2.0]), 0.5, rows=8, columns=4)
    covered = np.zeros((8, 4), bool)
    covered[grid.window(np.array([-0.5, 1.0]), np.array([0.5, 99.0]))] = True
    expected = np.zeros((8, 4), bool)
    expected[:2, 1:3] = True
    np.testing.assert_array_equal(covered, expected)


# Sheets


@pytest.mark.parametrize(("rows", "columns", "stacked"), [(50, 100, True), (100, 100, False)])
def test_a_plan_shows_each_cell_as_a_square_of_the_same_size(rows, columns, stacked):
    grid = PlanGrid(np.zeros(2), 0.2, rows, columns)
    cells = np.full((rows, columns, 3), WHITE, np.uint8)
    cells[[0, -1], [0, -1]] = RED
    sheet = draw_sheet(["a title"], grid, [Panel("one", cells), Panel("two", cells)])
    found = pixels_of(sheet, RED)
    zoom = round(np.sqrt(len(found) / 4))
    assert len(found) == 4 * zoom**2
    assert zoom * columns >= 600
    span = found.max(axis=0) - found.min(axis=0) + 1
    assert (span >= zoom * np.array([rows, columns])).all()
    down, across = span > 1.5 * zoom * np.array([rows, columns])
    assert (down, across) == (stacked, not stacked)
    assert sheet.width > span[1]
    assert sheet.height > span[0]


def test_titles_legends_and_notes_take_their_room():
    grid = PlanGrid(np.zeros(2), 0.2, 40, 100)
    cells = np.full((40, 100, 3), WHITE, np.uint8)
    bare = draw_sheet([], grid, [Panel("plan", cells)])
    many = tuple(Swatch("#ff0000", f"what the colour {i} stands for") for i in range(9))
    scale = ColourScale("height in m", HEIGHT, -1.0, 4.0)
    full = draw_sheet(["A" * 500, "B"], grid, [Panel("plan", cells, scale, many, "a note")])
    assert full.width == bare.width
    assert full.height > bare.height + 100
    swatches = pixels_of(full, RED)
    assert len(swatches) == 9 * 15 * 13  # whole, inside of their outlines
    assert len(np.unique(swatches[:, 0] // 24)) >= 3  # in several lines
    assert len(pixels_of(full, rgb(HEIGHT[0]))) >= 10
    assert len(pixels_of(full, rgb(HEIGHT[-1]))) >= 10


@pytest.mark.parametrize("stops", [HEIGHT, HEAT, AGE])
def test_colours_differ_in_lightness_all_along(stops):
    colours = ColourScale("", stops, 0.0, 1.0).colours(np.linspace(0.0, 1.0, 20))
    lightness = colours @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 0).all() or (np.diff(lightness) < 0).all()


def test_colours_end_at_the_limits_and_leave_out_what_is_not_known():
    scale = ColourScale("", HEAT, 2.0, 4.0)
    colours = scale.colours(np.array([-9.0, 2.0, 4.0, 99.0, np.nan]))
    np.testing.assert_array_equal(colours[0], colours[1])
    np.testing.assert_array_equal(colours[2], colours[3])
    assert tuple(colours[4]) == WHITE


# What the plans show


def test_columns_have_their_highest_surface():
    record = exact_map(table(0.1, 1.1))
    columns = surface_columns(record)
    assert len(columns.tops) == 100 * 100
    inside = np.abs(columns.middles).max(axis=1) < 2.0
    np.testing.assert_allclose(columns.tops[inside], 1.1)
    np.testing.assert_allclose(columns.tops[~inside], 0.1)
    assert np.abs(columns.middles).max() == pytest.approx(SEEN_M - 0.1)
    assert seen_columns(record).tops.max() == pytest.approx(1.1 + 10 * 0.2)


def test_each_place_shows_the_epoch_in_which_it_last_changed(tmp_path):
    file = read_map_file(write_checkpoints(tmp_path, (9, 12, 15))[-1])
    grid = PlanGrid(np.array([-18.0, -6.0]), 0.25, rows=48, columns=96)
    epochs = latest_epochs(grid, file.manifest)
    assert (FIRST, SECOND) == ((0, 0, 0), (-1, 0, 0))  # the second one is to the left
    assert np.unique(epochs[:, :48]).tolist() == [15]
    assert np.unique(epochs[:, 48:]).tolist() == [9]


def test_errors_are_those_of_the_labels():
    found = sample_errors(exact_map(flat(0.1), label_error_m=0.03))
    np.testing.assert_allclose(found.errors_m, 0.03, atol=1e-5)
    assert len(found.points) == 2000
    assert not len(sample_errors(exact_map(flat(0.1), label_error_m=0.5)).points)
    assert not len(sample_errors(exact_map(flat(0.1))).points)


# The command


def test_picture_of_a_map(tmp_path, capsys):
    path, picture = tmp_path / "map.triquad", tmp_path / "map.png"
    # A table on the ground shows in the colours of both heights.
    record = exact_map(table(0.1, 1.1), label_error_m=0.03)
    write_map(record, path, feature_dtype="<f4", stamp_ns=10**18)
    assert main([str(path), "--plot", str(picture)]) == 0
    assert "map 'ground'" in capsys.readouterr().out
    pixels = read_picture(picture)
    assert pixels.shape[1] > 3 * 600
    ground = pixels_of(pixels[:, : pixels.shape[1] // 3], rgb(HEIGHT[0]))
    top = pixels_of(pixels[:, : pixels.shape[1] // 3], rgb(HEIGHT[-1]))
    in_plan = top[top[:, 0] < ground[:, 0].max()]
    assert len(in_plan) / len(ground) == pytest.approx(4.0 / 96.0, rel=0.05)
    np.testing.assert_allclose(
        np.median(in_plan, axis=0), np.median(ground, axis=0), atol=len(pixels) / 50
    )


def test_pictures_of_maps_that_lack_something(tmp_path):
    deltas = write_checkpoints(tmp_path, (9, 12))
    write_map(random_record(indices=()), tmp_path / "empty.triquad")
    write_map(random_record(1, training=False), tmp_path / "plain.triquad")
    for path in (*deltas, tmp_path / "empty.triquad", tmp_path / "plain.triquad"):
        assert main([str(path), "--plot", str(tmp_path / "a.png"), "--json"]) == 0
        assert read_picture(tmp_path / "a.png").shape[0] > 300


def test_picture_of_a_difference(tmp_path):
    for name, height in (("a", flat(0.1)), ("b", table(0.1, 1.1))):
        write_map(exact_map(height), tmp_path / f"{name}.triquad", feature_dtype="<f4")
    a, b = str(tmp_path / "a.triquad"), str(tmp_path / "b.triquad")
    counts = {}
    for first, second in ((a, b), (b, a), (a, a)):
        picture = tmp_path / "diff.png"
        assert main([first, second, "--diff", "--plot", str(picture)]) == 0
        pixels = read_picture(picture)
        counts[first, second] = [len(pixels_of(pixels, c)) for c in (ADDED, GONE)]
    swatch = 15 * 13
    assert counts[a, a] == [swatch, swatch]
    assert counts[a, b][0] > 20 * swatch
    assert counts[a, b][1] == swatch
    assert counts[b, a] == counts[a, b][::-1]


def test_the_picture_of_a_file_has_the_colours_of_its_ages(tmp_path):
    from triquad_tools.plots.plan_view import plan_picture

    picture = plan_picture("map", read_map_file(write_checkpoints(tmp_path, (9,))[0]))
    assert len(pixels_of(picture, rgb(AGE[-1]))) > 10_000
