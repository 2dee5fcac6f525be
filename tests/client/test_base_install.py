import subprocess
import sys

import pytest
from support.files.mapfile_edit import file_bytes, parts_of
from support.maps.exact_maps import exact_map, flat
from support.maps.map_records import random_record
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_tools.commands import pack

CODE = """
import sys
import triquad_client, triquad_format.mapfile.reader
heavy = {"torch", "numba", "skimage", "scipy", "triquad_server"}
heavy |= {"google.protobuf", "foxglove_schemas_protobuf"}
heavy &= set(sys.modules)
sys.exit(f"importing the client brought in {heavy}" if heavy else 0)
"""


def test_client_comes_without_the_server_and_its_libraries():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


WITHOUT = """
import sys
for name in sys.argv[2:]:
    sys.modules[name] = None  # as if it were not installed
import triquad_client
with triquad_client.open_map(sys.argv[1]) as offline:
    print(len(offline.mesh(cell_m=0.4).faces))
assert not {"triquad_server", "triquad_tools"} & sys.modules.keys()
"""


def faces_without(path, *libraries):
    """What a program prints of the mesh of a map, without some libraries."""
    command = [sys.executable, "-c", WITHOUT, path, *libraries]
    return subprocess.run(command, capture_output=True, text=True)


def test_a_map_file_has_a_mesh_with_numba_alone(tmp_path):
    path = tmp_path / "map.triquad"
    write_map(exact_map(flat(0.1)), path)
    done = faces_without(path, "torch", "skimage", "scipy", "trimesh")
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 1000
    done = faces_without(path, "numba", "llvmlite")
    assert done.returncode == 1
    assert done.stderr.endswith("numba is missing: pip install 'triquad[fast]'\n")


WITHOUT_HEAVY = """
import sys
heavy = ("google", "foxglove_schemas_protobuf", "torch", "numba", "scipy", "skimage", "trimesh")
for name in (*heavy, "matplotlib"):
    sys.modules[name] = None
from triquad_tools.commands import entry_points
command, *sys.argv[1:] = sys.argv[1:]
sys.exit(getattr(entry_points, command)())
"""


def run_without_heavy_libraries(command, *arguments):
    """Run a tool where only the base is installed, and rich."""
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_HEAVY, command, *map(str, arguments)],
        capture_output=True,
        text=True,
    )


@pytest.fixture
def map_with_preview(tmp_path):
    path = tmp_path / "map.triquad"
    path.write_bytes(file_bytes(random_record(1), preview=True))
    return path


def test_a_map_with_a_preview_is_verified_without_heavy_libraries(map_with_preview):
    done = run_without_heavy_libraries("inspect", map_with_preview)
    assert done.returncode == 0, done.stderr
    assert "/preview/mesh" in done.stdout
    assert done.stderr == ""


@pytest.mark.parametrize("crop", [(), ("--crop", -9, -9, -9, 9, 9, 9)])
def test_a_map_with_a_preview_is_rewritten_without_heavy_libraries(
    map_with_preview, tmp_path, crop
):
    """Without the preview, and the user is told so."""
    copy = tmp_path / "copy.triquad"
    done = run_without_heavy_libraries("pack", map_with_preview, copy, *crop)
    assert done.returncode == 0, done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "install triquad[preview]" in done.stderr
    assert read_map(copy).has_evidence
    assert "/preview/mesh" not in {part.topic for part in parts_of(copy.read_bytes())}


def test_a_map_file_is_written_with_previews_where_they_can_be_made(map_with_preview, tmp_path):
    copy = tmp_path / "copy.triquad"
    assert pack.main([str(map_with_preview), str(copy)]) == 0
    assert "/preview/mesh" in {part.topic for part in parts_of(copy.read_bytes())}


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("demo", (), "numba is missing: install triquad[demo]"),
        ("evaluate", ("x.ply", "--reference", "x.ply"), "scipy is missing: install triquad[tools]"),
        ("inspect", ("MAP", "--plot", "map.png"), "numba is missing: pip install 'triquad[fast]'"),
        ("pack", ("MAP", "mesh.ply"), "numba is missing: pip install 'triquad[fast]'"),
    ],
)
def test_a_tool_whose_libraries_are_missing_says_what_to_install(
    map_with_preview, tmp_path, command, arguments, message
):
    places = {"MAP": map_with_preview, "mesh.ply": tmp_path / "mesh.ply"}
    given = [places.get(argument, argument) for argument in arguments]
    done = run_without_heavy_libraries(command, *given)
    assert done.returncode == 2
    passing = ("meshing", "no compiled code")  # what goes on, and why it takes long
    told = [line for line in done.stderr.splitlines() if not line.startswith(passing)]
    assert len(told) == 1
    assert told[0].endswith(message)


CLIENT_ALONE = """
import sys
more = "argcomplete cryptography laspy llvmlite PIL prometheus_client pydantic pypcd4 rich rosbags"
heavy = "foxglove_schemas_protobuf google matplotlib numba scipy skimage torch trimesh viser"
for name in f"{more} {heavy}".split():
    sys.modules[name] = None  # as if it were not installed
command, *sys.argv[1:] = sys.argv[1:]
from triquad_server.cli import main as server
from triquad_tools.commands import entry_points
sys.exit(server() if command == "server" else getattr(entry_points, command)())
"""


@pytest.mark.parametrize(
    ("command", "arguments", "told"),
    [
        ("demo", (), "numba is missing: install triquad[demo]"),
        ("evaluate", ("x.ply", "--reference", "x"), "rich is missing: install triquad[tools]"),
        ("inspect", ("x.triquad",), "rich is missing: install triquad[tools]"),
        ("keys", ("list", "."), "rich is missing: install triquad[keys]"),
        ("map_recording", ("x", "x.triquad"), "numba is missing: install triquad[demo]"),
        ("pack", ("x.triquad", "x.ply"), "rich is missing: install triquad[tools]"),
        ("replay", ("x", "--list"), "rosbags is missing: install triquad[tools]"),
        ("ros2", (), "rosbags is missing: install triquad[ros]"),
        ("server", (), "numba and pydantic are missing: install triquad[server]"),
        ("top", (), "rich is missing: install triquad[tools]"),
        ("view", (), "viser is missing: install triquad[viewer]"),
    ],
)
def test_with_the_client_alone_each_command_says_what_to_install(command, arguments, told):
    line = [sys.executable, "-c", CLIENT_ALONE, command, *arguments]
    done = subprocess.run(line, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    (said,) = done.stderr.splitlines()
    assert said.endswith(told)
