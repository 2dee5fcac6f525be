"""The commands of the pages run as they are shown, on small files by the names that pages use."""

import importlib
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support import servers
from support.maps import small_world
from support.pages import PARSERS, commands
from support.recordings.bags import drive, messages_for, write_bag
from support.recordings.kitti_folder import write_folder
from support.recordings.point_files import columns, write_ply
from support.recordings.trajectories import write_tum
from triquad_client import Mesh
from triquad_client.pose import Pose
from triquad_tools.commands import demo, keys, map_recording

from bench.clients.server_process import free_port

SCANS = 4
STAMPS = [10**18 + number * 10**8 for number in range(SCANS)]
MAPS = ("map", "IN", "FILE", "A", "B", "monday", "tuesday", "demo-again/map")
STORES = ("STORE", "store", "served", "OTHER", "maps")
RECORDINGS = ("RECORDING", "MONDAY", "TUESDAY", "FOLDER")
WRITTEN = (".triquad", ".png", ".ply", ".mcap", ".yaml", ".bt", ".npz")
ENDPOINTS = ("tcp/127.0.0.1:7447", "tcp/robot:7447")
LISTENING = "--listen"  # and what follows

ELSEWHERE = {
    "triquad-demo": "a minute each: tests/end_to_end/process/test_demo.py, and the fixture here",
    "triquad-ros2": "with robots: tests/end_to_end/ros2",
    "--workers": "of processes that share the work: tests/tools/commands/test_map_batch.py",
    "--preset indoor --intrinsics": "of images: tests/tools/recordings/test_depth_folder.py",
    "--odometry": "of a drive without poses: tests/tools/odometry/test_odometry.py",
    "triquad-eval paper": "of minutes: tests/tools/commands/test_paper.py",
    "--config keys": "goes on with the command before: tests/attacks",
    "--cluster": "of processes that share the work: tests/tools/commands/test_map_batch.py",
    "triquad-view drive.triquad": "shows a map file, as map.triquad is shown",
    "--align": "of two frames: tests/tools/commands/test_pack_merge.py",
    "--share": "of two servers: tests/end_to_end/process/test_shared_map.py",
    "--at 2026": "of a store that old: tests/tools/mapfiles/test_checkpoint_history.py",
    "epoch-000000015": "shows what it prints: tests/tools/commands/test_inspect.py",
}
"""What commands have that are not run here, and where they are."""

SHOWN = commands()
RUN = [line for line in SHOWN if not any(text in line for text in ELSEWHERE)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Maps, stores, recordings and meshes of a short drive."""
    path = tmp_path_factory.mktemp("pages")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        patch.setenv("TRIQUAD_TRAINING__SAMPLES_PER_RAY", "2")
        patch.setenv("TRIQUAD_STORE__LOG_MAX_BYTES", "100000000")  # scans are kept, too
        assert demo.main(["--out", str(path / "demo-out"), "--scans", str(SCANS)]) in (0, 1)
        for name in STORES:
            shutil.copytree(path / "demo-out" / "store", path / name)
        (path / "demo-again").mkdir()
        for name in MAPS:
            for suffix in ("", ".triquad"):
                shutil.copy(path / "demo-out" / "map.triquad", path / f"{name}{suffix}")
        _write_recordings(path)
        assert map_recording.main(["RECORDING", "west.triquad", "--training"]) == 0
        shutil.copy("west.triquad", "east.triquad")
        shutil.copy(servers.SMALL_FILE, "FILE.toml")
        whole = (path / "IN").read_bytes()
        for name in ("BROKEN", "broken.triquad"):
            (path / name).write_bytes(whole[: len(whole) - 1000])
        yield path


def _write_recordings(path: Path) -> None:
    world = small_world.world(SCANS)
    points = [scan.points for scan in world.scans]
    poses = np.array([scan.world_from_sensor for scan in world.scans])
    for name in RECORDINGS:
        write_folder(path / name, points, poses, STAMPS)
    messages = drive(messages_for("ros1"), points, poses, STAMPS, np.eye(4))
    write_bag(path / "drive", "ros1", messages)
    (path / "scans").mkdir()
    for number, cloud in enumerate(points):
        write_ply(path / "scans" / f"{number:06d}.ply", columns(cloud))
    moves = [Pose(pose[:3, 3], (0.0, 0.0, 0.0, 1.0)) for pose in poses]  # without its turns
    write_tum(path / "poses.tum", STAMPS, moves)
    Mesh(world.hits, np.zeros((0, 3), np.int32), None).save(path / "CLOUD.ply")
    shutil.copy(path / "demo-out" / "street.ply", path / "MESH.ply")


@pytest.fixture(scope="module")
def endpoint(folder: Path) -> Iterator[str]:
    words = ["--map", "default", "--map", "demo", "--store", folder / "served"]
    with servers.server_process(words) as server:
        yield server.endpoint


@pytest.mark.parametrize("line", RUN)
def test_commands_do_what_the_pages_show(
    line: str, folder: Path, endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for entry in folder.iterdir():
        if entry.name != "maps":  # which is written to
            (tmp_path / entry.name).symlink_to(entry)
    shutil.copytree(folder / "maps", tmp_path / "maps")
    monkeypatch.chdir(tmp_path)
    command, *words = shlex.split(line, comments=True)
    words = [endpoint if word in ENDPOINTS else word for word in words]
    if command == "triquad-keys" and words[0] != "init":
        assert keys.main(["init", "keys"]) == 0
    if command == "triquad-server":
        _serve(words)
    elif command == "triquad-view":
        _view(words, endpoint)
    else:
        once = ["--once"] if command == "triquad-top" else []
        work = importlib.import_module(PARSERS[command][0])
        assert work.main([*words, *once]) == 0
        assert all(Path(word).exists() for word in words if word.endswith(WRITTEN))


def _serve(words: list[str]) -> None:
    """Start a server where it cannot meet others, and stop it."""
    if LISTENING in words:
        del words[words.index(LISTENING) : words.index(LISTENING) + 2]
    with servers.server_process(words) as server:
        server.process.send_signal(signal.SIGINT)
        assert server.wait() == 0


def _view(words: list[str], endpoint: str) -> None:
    """Show a map until its address is told."""
    if all(word.startswith("--") or word == "demo" for word in words):
        words += ["--connect", endpoint]
    program = "from triquad_tools.commands.view import main; raise SystemExit(main())"
    command = [sys.executable, "-c", program, *words, "--port", str(free_port())]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as viewer:
        late = threading.Timer(servers.WAIT_S, viewer.kill)
        late.start()
        assert viewer.stdout is not None
        told = next((text for text in viewer.stdout if "http://" in text), None)
        late.cancel()
        viewer.send_signal(signal.SIGINT)
        assert told, "no address was told"
        assert viewer.wait(servers.WAIT_S) == 130


def test_whatever_is_not_run_is_on_some_page() -> None:
    assert [text for text in ELSEWHERE if text not in "\n".join(SHOWN)] == []
    assert len(RUN) > 40
