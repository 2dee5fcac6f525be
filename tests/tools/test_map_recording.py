"""A recording in, a map out: no server, and nothing lost by an interruption."""

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from support import servers
from support.bags import KINDS, BagKind, drive, messages_for, write_bag
from support.kitti_folder import write_folder
from triquad_client import Status, open_map
from triquad_format.mapfile.reader import read_map
from triquad_tools.commands.map_recording import main
from triquad_tools.mapfiles.meshfile import read_mesh

ROS2 = messages_for("mcap")
COUNT = 8
POSES = np.tile(np.eye(4), (COUNT, 1, 1))
POSES[:, 0, 3] = 0.05 * np.arange(COUNT)
STAMPS = [10**18 + i * 10**8 for i in range(COUNT)]
SPHERE = servers.sphere(2000)


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(servers.SMALL_TOML)
    return path


def scans() -> list[np.ndarray]:
    """What a sensor sees of a sphere around the map's origin while it moves."""
    return [(SPHERE - pose[:3, 3]).astype(np.float32) for pose in POSES]


def folder(tmp_path: Path) -> Path:
    write_folder(tmp_path / "scans", scans(), POSES, STAMPS)
    return tmp_path / "scans"


def error_of(path: Path) -> float:
    with open_map(path) as opened:
        answer = opened.query_sdf(SPHERE)
        assert (answer.status == Status.SURFACE).mean() > 0.95
        return float(np.nanmedian(np.abs(answer.sdf)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_the_map_of_its_folder(tmp_path: Path, settings: Path, kind: BagKind) -> None:
    bag = drive(messages_for(kind), scans(), POSES, STAMPS, np.eye(4))
    of_folder, of_bag = tmp_path / "folder.triquad", tmp_path / "bag.triquad"
    for recording, output in (
        (folder(tmp_path), of_folder),
        (write_bag(tmp_path / "bag", kind, bag), of_bag),
    ):
        assert main([str(recording), str(output), "--settings", str(settings)]) == 0
        assert not output.with_name(f"{output.name}.part").exists()
    assert abs(error_of(of_bag) - error_of(of_folder)) < 0.01
    evidence = [read_map(path).regions[0].evidence for path in (of_folder, of_bag)]
    assert np.array_equal(evidence[0].codes, evidence[1].codes)


def test_the_name_says_what_is_written(tmp_path: Path, settings: Path, capsys) -> None:
    recording = folder(tmp_path)
    for name in ("map.ply", "map.glb", "map.png"):
        path = tmp_path / name
        assert main([str(recording), str(path), "--settings", str(settings)]) == 0
        assert str(path) in capsys.readouterr().out
    for name in ("map.ply", "map.glb"):
        radii = np.linalg.norm(read_mesh(tmp_path / name).vertices, axis=1)
        assert np.median(np.abs(radii - servers.RADIUS_M)) < 0.1
    assert imread(tmp_path / "map.png").std() > 0.02


def test_training_state_is_kept_on_request(tmp_path: Path, settings: Path) -> None:
    recording = folder(tmp_path)
    for name, flags, kept in (("a.triquad", [], False), ("b.triquad", ["--training"], True)):
        path = tmp_path / name
        assert main([str(recording), str(path), "--settings", str(settings), *flags]) == 0
        assert (read_map(path).regions[0].training is not None) is kept


@contextmanager
def mapping(
    *arguments: object, until: str = "training"
) -> Iterator[tuple[subprocess.Popen[str], threading.Event]]:
    """The command as a process, and whether it has begun with a stage."""
    code = "from triquad_tools.commands.entry_points import map_recording as run; exit(run())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)], stderr=subprocess.PIPE, text=True
    )
    training = threading.Event()
    process.lines = []

    def read() -> None:
        for line in process.stderr:
            process.lines.append(line)
            if line.startswith(until):
                training.set()
        training.set()

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield process, training
    finally:
        process.kill()
        process.wait()
        reader.join()
        process.stderr.close()


LONG = ("--set", "training.samples_per_ray=500", "--set", "training.batch=2048")


def test_after_ctrl_c_the_same_command_goes_on(tmp_path: Path, settings: Path, capsys) -> None:
    output = tmp_path / "map.triquad"
    arguments = (folder(tmp_path), output, "--settings", settings, *LONG)
    with mapping(*arguments) as (process, training):
        assert training.wait(servers.WAIT_S)
        process.send_signal(signal.SIGINT)
        assert process.wait(servers.WAIT_S) == 130
    assert process.lines[-1] == "triquad-map: interrupted; the same command goes on where it was\n"
    assert not output.exists()
    assert main([*map(str, arguments[:2]), "--settings", str(settings)]) == 2
    assert "of another recording, or with other flags or settings" in capsys.readouterr().err
    assert main(list(map(str, arguments))) == 0
    assert f"going on after scan {COUNT}" in capsys.readouterr().out
    assert error_of(output) < 0.1
    assert not output.with_name("map.triquad.part").exists()


def test_however_often_it_is_interrupted_no_scan_is_lost(tmp_path: Path, settings: Path) -> None:
    recording, whole = folder(tmp_path), tmp_path / "whole.triquad"
    assert main([str(recording), str(whole), "--settings", str(settings)]) == 0
    output = tmp_path / "map.triquad"
    arguments = (recording, output, "--settings", settings)
    for moment in ("preparing", "mapping", "mapping", "training", "training"):
        with mapping(*arguments, until=moment) as (process, reached):
            assert reached.wait(servers.WAIT_S)
            process.send_signal(signal.SIGINT)
            process.wait(servers.WAIT_S)
    if not output.exists():
        assert main(list(map(str, arguments))) == 0
    ours, theirs = (read_map(path).regions[0].evidence for path in (output, whole))
    assert np.array_equal(ours.codes, theirs.codes)
    assert np.array_equal(ours.surface, theirs.surface)


def test_what_somebody_else_put_beside_the_output_stays(
    tmp_path: Path, settings: Path, capsys
) -> None:
    output = tmp_path / "map.triquad"
    part = tmp_path / "map.triquad.part"
    (part / "recording").mkdir(parents=True)
    (part / "recording" / "mine.txt").write_text("precious")
    arguments = [str(folder(tmp_path)), str(output), "--settings", str(settings)]
    assert main(arguments) == 2
    assert "holds something else; move it away" in capsys.readouterr().err
    assert (part / "recording" / "mine.txt").read_text() == "precious"


def test_nothing_stays_of_input_that_is_refused(tmp_path: Path, settings: Path) -> None:
    near = ("--set", "scan.range_min_m=30", "--settings", str(settings))
    recording = folder(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert main([str(recording), str(tmp_path / "map.triquad"), *near]) == 2
    assert sorted(tmp_path.iterdir()) == before


def test_other_poses_do_not_go_on_with_the_same_map(tmp_path: Path, settings: Path, capsys) -> None:
    messages = [
        m for m in drive(ROS2, scans(), POSES, STAMPS, np.eye(4)) if "static" not in m.topic
    ]
    bag, output = write_bag(tmp_path / "bag", "mcap", messages), tmp_path / "map.triquad"
    arguments = (bag, output, "--settings", settings, *LONG, "--transform")
    with mapping(*arguments, "base_link lidar 0 0 1 0 0 0 1") as (process, training):
        assert training.wait(servers.WAIT_S)
        process.send_signal(signal.SIGINT)
        assert process.wait(servers.WAIT_S) == 130
    assert main([*map(str, arguments), "base_link lidar 0 0 0 0 0 0 1"]) == 2
    assert "with other flags or settings" in capsys.readouterr().err


def test_after_a_kill_the_same_command_makes_the_map(tmp_path: Path, settings: Path) -> None:
    output = tmp_path / "map.triquad"
    arguments = (folder(tmp_path), output, "--settings", settings, *LONG)
    with mapping(*arguments) as (process, training):
        assert training.wait(servers.WAIT_S)
        process.kill()
        process.wait()
    assert not output.exists()
    assert main(list(map(str, arguments))) == 0
    assert error_of(output) < 0.1


def test_input_that_cannot_be_used_is_refused(tmp_path: Path, settings: Path, capsys) -> None:
    recording = folder(tmp_path)
    exists = tmp_path / "exists.triquad"
    exists.write_bytes(b"x")
    for arguments, words in (
        ((tmp_path / "nowhere", tmp_path / "a.triquad"), "no such file or folder"),
        ((tmp_path, tmp_path / "a.triquad"), "no recording that is understood"),
        ((recording, tmp_path / "a.obj2"), "use a name that ends in"),
        ((recording, exists), "give --force to replace it"),
        ((recording, tmp_path / "none" / "a.triquad"), "is not a folder: make it first"),
        ((recording, tmp_path / "a.triquad", "--set", "scan.range=5"), "unknown setting"),
        ((recording, tmp_path / "a.triquad", "--start", "99"), "no scan is left"),
        ((recording, tmp_path / "a.triquad", "--stride", "2"), "for which --stride means nothing"),
        ((recording, tmp_path / "a.triquad", "--transform", "a b"), "use 'PARENT CHILD X Y Z"),
    ):
        assert main(list(map(str, arguments))) == 2
        assert words in capsys.readouterr().err
    assert exists.read_bytes() == b"x"


def test_a_recording_of_which_nothing_can_be_used_is_told(
    tmp_path: Path, settings: Path, capsys
) -> None:
    near = ("--set", "scan.range_min_m=30", "--settings", str(settings))
    output = tmp_path / "map.triquad"
    assert main([str(folder(tmp_path)), str(output), *near]) == 2
    error = capsys.readouterr().err
    assert (
        "nothing was mapped: 8 of 8 scans could not be used (empty: 8); the last: scan 7" in error
    )
    assert not output.exists()


def test_a_preset_lies_below_the_settings(tmp_path: Path, settings: Path) -> None:
    output = tmp_path / "map.triquad"
    command = [str(folder(tmp_path)), str(output), "--preset", "long-range"]
    assert main([*command, "--settings", str(settings)]) == 0
    field = read_map(output).settings
    assert (field.leaf_m, field.depth) == (0.4, 7)
