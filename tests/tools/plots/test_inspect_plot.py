import numpy as np
import pytest
import triquad_client
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from support import servers
from support.files.checkpoint_folder import write_checkpoints
from support.maps.exact_maps import exact_map, flat, table
from triquad_format.mapfile.writer import write_map
from triquad_tools.commands.inspect import main
from triquad_tools.plots.colours import APPEARED, FREE, UNKNOWN, VANISHED


def read_picture(path):
    """Pixels ``[rows, columns, 3]`` of 0 to 255."""
    return (255 * imread(path)[:, :, :3]).round().astype(np.uint8)


def share(pixels, colour):
    """Share of a picture's pixels that have a colour, but for how it was rounded."""
    return (np.abs(pixels - 255 * np.array(to_rgb(colour))) <= 1).all(axis=-1).mean()


@pytest.mark.parametrize("name", ["viridis", "plasma_r"])
def test_what_is_not_known_has_a_colour_of_its_own(name):
    colours = colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3]
    for other in (UNKNOWN, FREE):
        assert np.abs(colours - to_rgb(other)).max(axis=1).min() > 0.2
    lightness = colours @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 0).all() or (np.diff(lightness) < 0).all()


def test_of_a_folder_of_checkpoints_the_newest_is_shown(tmp_path, capsys):
    write_checkpoints(tmp_path, (9, 12, 15))
    for options, epoch in (((), 15), (("--at", "13"), 12)):
        assert main([str(tmp_path), *options]) == 0
        output = capsys.readouterr().out
        assert f"epoch {epoch}," in output
        assert f"epoch-{epoch:09}" in output
    assert main([str(tmp_path), "--at", "3"]) == 2
    assert main([str(tmp_path), "--log", "--at", "13"]) == 2
    assert "--at is for one map" in capsys.readouterr().err
    file = next(tmp_path.glob("*.checkpoint"))
    assert main([str(file), "--at", "13"]) == 2
    assert "is one map file: --at asks for a folder" in capsys.readouterr().err


def test_the_map_of_a_server_is_drawn(tmp_path, capsys):
    picture = tmp_path / "a.png"
    with servers.running_service() as endpoint:
        with triquad_client.connect(endpoint) as client:
            client.publish_scan(servers.sphere(3000), np.eye(4))
            client.flush()
        assert main([endpoint, "--plot", str(picture)]) == 0
        assert f"{endpoint}: map 'default'" in capsys.readouterr().out
        assert read_picture(picture).std() > 5
        assert main([endpoint, "--at", "1", "--plot", str(picture)]) == 2
        assert "leave out --at" in capsys.readouterr().err
    assert main([str(tmp_path), "--map", "other"]) == 2
    assert "--map and --config are of a server" in capsys.readouterr().err


def test_picture_of_a_difference(tmp_path):
    for name, height in (("a", flat(0.1)), ("b", table(0.1, 1.1))):
        write_map(exact_map(height), tmp_path / f"{name}.triquad", feature_dtype="<f4")
    a, b = str(tmp_path / "a.triquad"), str(tmp_path / "b.triquad")
    shares = {}
    for first, second in ((a, b), (b, a), (a, a)):
        picture = tmp_path / "diff.png"
        assert main([first, second, "--diff", "--plot", str(picture)]) == 0
        pixels = read_picture(picture)
        shares[first, second] = [share(pixels, colour) for colour in (APPEARED, VANISHED)]
    legend = shares[a, a]  # which has all colours
    assert shares[a, b][0] > 20 * legend[0]
    assert shares[a, b][1] == pytest.approx(legend[1])
    assert shares[b, a][1] > 20 * legend[1]
    assert shares[b, a][0] == pytest.approx(legend[0])
