"""A recording in, a map out: no server, and nothing lost by an interruption."""

import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import triquad_server
from matplotlib.image import imread
from support import servers
from support.recordings.bags import drive, messages_for, write_bag
from support.recordings.kitti_folder import write_folder
from triquad_client import Status, open_map
from triquad_format.mapfile.reader import read_map
from triquad_tools.commands.inspect import main as inspect
from triquad_tools.commands.map_recording import main
from triquad_tools.mapfiles.meshfile import read_mesh
from triquad_tools.mapping.output import write_output

COUNT = 8
POSES = np.tile(np.eye(4), (COUNT, 1, 1))
POSES[:, 0, 3] = 0.05 * np.arange(COUNT)
STAMPS = [10**18 + i * 10**8 for i in range(COUNT)]
SPHERE = servers.sphere(2000)
SETTINGS = str(servers.SMALL_FILE)
# Long enough to be interrupted while it trains.
LONG = ("--set", "training.samples_per_ray=150", "--set", "training.batch=2048")


def scans() -> list[np.ndarray]:
    """What a sensor sees of a sphere around the map's origin while it moves."""
    return [(SPHERE - pose[:3, 3]).astype(np.float32) for pose in POSES]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("recording") / "scans"
    write_folder(path, scans(), POSES, STAMPS)
    return str(path)


@pytest.fixture(scope="module")
def whole(recording: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the recording, made without an interruption, with its training state."""
    path = tmp_path_factory.mktemp("whole") / "whole.triquad"
    assert main([recording, str(path), "--settings", SETTINGS, "--training"]) == 0
    assert not path.with_name("whole.triquad.part").exists()
    return path


def error_of(path: Path) -> float:
    with open_map(path) as opened:
        answer = opened.query_sdf(SPHERE)
        assert (answer.status == Status.SURFACE).mean() > 0.95
        return float(np.nanmedian(np.abs(answer.sdf)))


def assert_no_scan_is_lost(path: Path, whole: Path) -> None:
    ours, theirs = (read_map(one).regions[0].evidence for one in (path, whole))
    assert np.array_equal(ours.codes, theirs.codes)
    assert np.array_equal(ours.surface, theirs.surface)


def test_a_bag_gives_the_map_of_its_folder(tmp_path: Path, whole: Path) -> None:
    messages = drive(messages_for("mcap"), scans(), POSES, STAMPS, np.eye(4))
    bag, output = write_bag(tmp_path / "bag", "mcap", messages), tmp_path / "bag.triquad"
    assert main([str(bag), str(output), "--settings", SETTINGS]) == 0
    assert abs(error_of(output) - error_of(whole)) < 0.02
    assert_no_scan_is_lost(output, whole)
    # Training state is kept on request alone.
    regions = [read_map(path).regions[0] for path in (output, whole)]
    assert [region.training is not None for region in regions] == [False, True]


def test_surface_is_continued_only_where_that_is_marked(
    tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("map.triquad", "map.stl"):
        assert main(["recording", str(tmp_path / name), "--fill", "1"]) == 2
        assert "--fill is of what can mark it, .ply, .glb, .obj, .png" in capsys.readouterr().err
    record = read_map(whole)
    told = write_output(record, tmp_path / "map.ply", cell_m=0.2, training=False, fill_m=1.0)
    assert told.endswith("of them filled")


def test_the_name_says_what_is_written(tmp_path: Path, whole: Path, capsys) -> None:
    record = read_map(whole)
    for name in ("map.ply", "map.glb"):
        assert "faces" in write_output(record, tmp_path / name, cell_m=0.2, training=False)
        radii = np.linalg.norm(read_mesh(tmp_path / name).vertices, axis=1)
        assert np.median(np.abs(radii - servers.RADIUS_M)) < 0.1
    capsys.readouterr()
    write_output(record, tmp_path / "map.png", cell_m=0.2, training=False)
    said = [line for line in capsys.readouterr().err.splitlines() if line.endswith(" ...")]
    assert said == ["meshing ...", "drawing ..."]
    assert imread(tmp_path / "map.png").std() > 0.02


@contextmanager
def mapping(*arguments: object, until: str) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """The command as a process that has begun with a stage, and what it says."""
    code = "from triquad_tools.commands.entry_points import map_recording as run; exit(run())"
    line = [sys.executable, "-c", code, *map(str, arguments)]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as process:
        begun = threading.Event()
        said: list[str] = []

        def read() -> None:
            assert process.stderr is not None
            for text in process.stderr:
                said.append(text)
                if text.startswith(until):
                    begun.set()
            begun.set()

        reader = threading.Thread(target=read)
        reader.start()
        try:
            assert begun.wait(servers.WAIT_S)
            yield process, said
        finally:
            process.kill()
            reader.join()


def test_after_ctrl_c_the_same_command_goes_on(
    tmp_path: Path, recording: str, whole: Path, capsys
) -> None:
    output = tmp_path / "map.triquad"
    arguments = [recording, str(output), "--settings", SETTINGS]
    with mapping(*arguments, *LONG, until="training") as (process, said):
        process.send_signal(signal.SIGINT)
        assert process.wait(servers.WAIT_S) == 130
    words = (
        "the same command goes on where the map was saved last, and with --train-for 0 it writes"
    )
    assert said[-1] == f"triquad-map: interrupted; {words} what is there\n"
    assert not output.exists()
    for other in ((), (*LONG, "--range-min", "0.1")):
        assert main([*arguments, *other]) == 2
        assert "of another recording, or with other flags or settings" in capsys.readouterr().err
    assert main([*arguments, *LONG]) == 0
    assert f"going on after scan {COUNT}" in capsys.readouterr().out
    assert error_of(output) < 0.1
    assert_no_scan_is_lost(output, whole)
    assert not output.with_name("map.triquad.part").exists()


def test_after_a_kill_the_same_command_makes_the_map(
    tmp_path: Path, recording: str, whole: Path
) -> None:
    output = tmp_path / "map.triquad"
    arguments = [recording, str(output), "--settings", SETTINGS]
    with mapping(*arguments, until="mapping") as (process, _):
        process.kill()
        process.wait()
    assert not output.exists()
    assert main(arguments) == 0
    assert_no_scan_is_lost(output, whole)


def test_a_first_look_says_how_far_it_is_and_more_is_learnt_from_there(
    tmp_path: Path, recording: str, whole: Path, capsys
) -> None:
    output = tmp_path / "map.triquad"
    arguments = [recording, str(output), "--settings", SETTINGS]
    assert main([*arguments, "--train-for", "0"]) == 0
    learnt = re.search(r"it has had (\d+) % of its training", capsys.readouterr().out)
    assert learnt is not None
    assert 0 < int(learnt[1]) < 100
    assert_no_scan_is_lost(output, whole)
    assert inspect([str(output)]) == 0
    assert f"training has not ended: {learnt[1]} % is learnt" in capsys.readouterr().out
    store = tmp_path / "store" / "default"
    store.mkdir(parents=True)
    shutil.copy(output, store / f"epoch-{read_map(output).epoch:09}.triquad")
    with (
        triquad_server.serve(store=tmp_path / "store", settings=SETTINGS) as server,
        server.client() as client,
    ):
        assert (
            client.settle(servers.WAIT_S).samples_trained
            > read_map(output).progress.samples_trained
        )
    assert main([*arguments, "--force"]) == 0
    assert f"going on after scan {COUNT}" in capsys.readouterr().out
    assert error_of(output) < 0.1
    assert_no_scan_is_lost(output, whole)
    assert not output.with_name("map.triquad.part").exists()


@pytest.mark.long
def test_however_often_it_is_interrupted_no_scan_is_lost(
    tmp_path: Path, recording: str, whole: Path
) -> None:
    output = tmp_path / "map.triquad"
    arguments = [recording, str(output), "--settings", SETTINGS]
    for moment in ("preparing", "mapping", "mapping", "training", "training"):
        with mapping(*arguments, until=moment) as (process, _):
            process.send_signal(signal.SIGINT)
            process.wait(servers.WAIT_S)
    if not output.exists():
        assert main(arguments) == 0
    assert_no_scan_is_lost(output, whole)


@pytest.mark.parametrize("name", ["map.triquad.part", "map.triquad.part/mine.txt"])
def test_what_somebody_else_put_beside_the_output_stays(
    tmp_path: Path, recording: str, capsys, name: str
) -> None:
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("precious")
    assert main([recording, str(tmp_path / "map.triquad"), "--settings", SETTINGS]) == 2
    assert "holds something else; move it away" in capsys.readouterr().err
    assert mine.read_text() == "precious"


def test_a_recording_of_which_nothing_can_be_used_is_told(
    tmp_path: Path, recording: str, capsys
) -> None:
    near = ("--set", "scan.range_min_m=30", "--settings", SETTINGS)
    assert main([recording, str(tmp_path / "map.triquad"), *near]) == 2
    words = "nothing was mapped: 8 of 8 scans could not be used (empty: 8); the last: scan 7"
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_memory_has_no_room_for_is_told_with_what_helps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    far = POSES.copy()
    far[:, 0, 3] = 3.0 * np.arange(COUNT)
    write_folder(tmp_path / "scans", [SPHERE] * COUNT, far, STAMPS)
    little = ("--set", "memory.max_bytes=5_000_000")
    words = [str(tmp_path / "scans"), str(tmp_path / "map.triquad"), "--settings", SETTINGS]
    assert main([*words, *little]) == 0
    told = capsys.readouterr().err
    assert re.search(r"\d of 8 scans could not be used \(map_full: \d\)", told)
    assert "--workers 2 maps region by region" in told


def test_poses_that_go_on_in_another_frame_are_refused(tmp_path: Path, capsys) -> None:
    """As where a first GPS fix comes late. A single pose that is wrong is left out and told."""
    for lost, status in ((1, 0), (3, 2)):
        poses, output = POSES.copy(), tmp_path / f"{lost}.triquad"
        poses[3 : 3 + lost, :3, 3] += (450_000.0, 5_400_000.0, 400.0)
        write_folder(tmp_path / f"{lost}", scans(), poses, STAMPS)
        assert main([str(tmp_path / f"{lost}"), str(output), "--settings", SETTINGS]) == status
        assert output.exists() == (status == 0)
        told = capsys.readouterr().err
        assert "from the map's origin 0 0 0, which the first scan" in told
        assert ("scan 4: " in told and "0.400 s after the first" in told) == (lost == 3)


def test_input_that_cannot_be_used_is_refused(tmp_path: Path, recording: str, capsys) -> None:
    exists, other = tmp_path / "exists.triquad", tmp_path / "a.triquad"
    exists.write_bytes(b"x")
    for arguments, words in (
        ((tmp_path / "nowhere", other), "no such file or folder"),
        ((tmp_path, other), "no recording that is understood"),
        ((exists, other), "is a map, not a recording: triquad-pack"),
        ((recording, tmp_path / "a.obj2"), "use a name that ends in"),
        ((recording, exists), "give --force to replace it"),
        ((recording, tmp_path / "none" / "a.triquad"), "is not a folder: make it first"),
        ((recording, other, "--set", "scan.range=5"), "unknown setting"),
        ((recording, other, "--start", "99"), "no scan is left"),
        ((recording, other, "--stride", "2"), "for which --stride means nothing"),
        ((recording, other, "--transform", "a b 0 0 0 0 0 0 1"), "for which --transform means"),
    ):
        assert main(list(map(str, arguments))) == 2
        assert words in capsys.readouterr().err
    assert exists.read_bytes() == b"x"


def test_a_preset_lies_below_the_settings(tmp_path: Path, recording: str) -> None:
    output = tmp_path / "map.triquad"
    command = [recording, str(output), "--every", str(COUNT), "--preset", "long-range"]
    assert main([*command, "--settings", SETTINGS]) == 0
    field = read_map(output).settings
    assert (field.leaf_m, field.depth) == (0.4, 7)
