"""Pictures of ``triquad-eval --plot``, read back."""

import json

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from support.exact_maps import SEEN_M, exact_map, flat
from support.kitti_folder import write_folder
from triquad_client import Mesh
from triquad_format.mapfile.writer import write_map
from triquad_tools.commands.evaluate import main
from triquad_tools.plots.error_picture import BEYOND, ERRORS, MISSING
from triquad_tools.plots.mesh_view import HEIGHT, WIDTH

GROUND_CELLS = 40


def sheet(z_of_strips, left_out=0.0, cell_m=0.1):
    """4 m x 4 m in strips along y of different heights, without what has less x than given."""
    at = np.arange(GROUND_CELLS) * cell_m
    corners = np.array([[0.0, 0.0], [cell_m, 0.0], [cell_m, cell_m], [0.0, cell_m]])
    x, y = (axis.ravel() for axis in np.meshgrid(at, at))
    strip = np.minimum((x / 4.0 * len(z_of_strips)).astype(int), len(z_of_strips) - 1)
    flat_corners = np.stack([x, y], axis=1)[:, None] + corners
    z = np.broadcast_to(np.array(z_of_strips)[strip][:, None, None], (len(x), 4, 1))
    vertices = np.concatenate([flat_corners, z], axis=2)[x >= left_out - 1e-9]
    faces = 4 * np.arange(len(vertices))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32))


@pytest.fixture
def truth(tmp_path):
    """A level cloud of 2 cm spacing over 4 m x 4 m, and a point above it."""
    x, y = np.meshgrid(np.arange(0.01, 4.0, 0.02), np.arange(0.01, 4.0, 0.02))
    path = tmp_path / "truth.ply"
    cloud = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    cloud = np.vstack([cloud, [2.0, 2.0, 1.0]])
    Mesh(cloud, np.empty((0, 3), np.int32)).save(path)
    return path


@pytest.fixture
def drawn(tmp_path, truth, capsys):
    """Draws a mesh against the truth; the picture within the sheet, and the scores."""

    def draw(mesh, *options):
        mesh.save(tmp_path / "mesh.ply")
        command = ["mesh", str(tmp_path / "mesh.ply"), "--reference", str(truth), *options]
        assert main([*command, "--json", "--plot", str(tmp_path / "errors.png")]) == 0
        scores = json.loads(capsys.readouterr().out)["mesh"]
        return read_picture(tmp_path / "errors.png"), scores

    return draw


def read_picture(path):
    """Pixels ``[rows, columns, 3]`` of 0 to 255, of a sheet of its size."""
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape == (900, 1600, 3)
    return pixels


def share(sheet_pixels, colour, within=30):
    """Share of the picture within a sheet that has a colour, but for shades."""
    pixels = sheet_pixels[90 : 90 + HEIGHT, :WIDTH]
    return (np.abs(pixels - 255 * np.array(to_rgb(colour))).max(axis=-1) <= within).mean()


def test_what_the_mesh_lacks_is_orange(drawn):
    whole, _ = drawn(sheet([0.0]))
    assert share(whole, MISSING) < 0.001  # a point in the air
    lacking, scores = drawn(sheet([0.0], left_out=1.0))
    assert scores["completion_ratio"] == pytest.approx(0.75, abs=0.03)
    orange, right = share(lacking, MISSING), share(lacking, ERRORS(0.0))
    assert orange / (orange + right) == pytest.approx(0.25, abs=0.06)


def test_errors_have_the_colours_of_the_scale(drawn):
    pixels, scores = drawn(sheet([0.0, 0.4 / 6, 0.8 / 6]))
    assert scores["outlier_ratio"] == 0.0
    assert all(share(pixels, ERRORS(place / 6)) > 0.05 for place in (0, 2, 4))
    assert share(pixels, ERRORS(1.0)) == 0.0
    assert share(pixels, BEYOND) == 0.0


def test_outliers_have_a_colour_of_their_own_and_are_told(drawn):
    without, _ = drawn(sheet([0.0]))
    pixels, scores = drawn(sheet([0.0, 0.0, 0.0, 0.3]), "--accuracy-cut", "0.25")
    assert scores["outlier_ratio"] > 0.1
    assert share(pixels, BEYOND) > 0.03
    tip = (slice(150, 170), slice(1362, 1392))
    for picture, marked in ((without, False), (pixels, True)):
        apart = np.abs(picture[tip] - 255 * np.array(to_rgb(BEYOND))).max(axis=-1)
        assert (apart <= 14).any() == marked


def test_a_mesh_that_is_all_elsewhere_leaves_all_of_the_truth_orange(drawn):
    mesh = sheet([0.0])
    pixels, scores = drawn(Mesh(mesh.vertices + [0.0, 0.0, 50.0], mesh.faces))
    assert scores["f_score"] == 0.0
    assert share(pixels, MISSING) > 0.1
    assert share(pixels, ERRORS(0.0)) < 0.001


def test_withheld_points_are_orange_where_the_map_knows_nothing(tmp_path, capsys):
    write_map(exact_map(flat(0.1)), tmp_path / "map.triquad", feature_dtype="<f4")
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-SEEN_M + 1.0, SEEN_M - 1.0, (2, 4000))
    seen = np.stack([x, y, np.full(4000, 0.1)], axis=1)
    unknown = seen[:1000] - [0.0, 0.0, 5.0]
    write_folder(tmp_path / "scans", [np.vstack([seen, unknown])], np.eye(4)[None], [0])
    out = tmp_path / "points.png"
    command = ["map", str(tmp_path / "map.triquad"), "--withheld", str(tmp_path / "scans")]
    assert main([*command, "--plot", str(out)]) == 0
    assert "SURFACE" in capsys.readouterr().out
    pixels = read_picture(out)
    assert share(pixels, MISSING) > 0.001
    assert share(pixels, ERRORS(0.0)) > 0.005
    assert main([*command, "--range-max", "0.01", "--plot", str(tmp_path / "none.png")]) == 2
    assert "the withheld scans have no points in range" in capsys.readouterr().err
    assert not (tmp_path / "none.png").exists()


@pytest.mark.parametrize(
    ("name", "reason"),
    [("a.jpg", "its name must end in .png"), ("none/a.png", "its folder does not exist")],
)
def test_a_picture_that_cannot_be_written_is_refused_at_once(tmp_path, capsys, name, reason):
    command = ["mesh", "mesh.ply", "--street", "1", "--plot", str(tmp_path / name)]
    with pytest.raises(SystemExit, match="2"):
        main(command)
    assert reason in capsys.readouterr().err
