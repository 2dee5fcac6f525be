"""A recording in, a map out, by many processes: the map that one makes, whatever happens."""

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from distributed import Client
from support import servers
from support.recordings.bags import drive, messages_for, write_bag
from support.recordings.kitti_folder import write_folder
from triquad_client import open_map
from triquad_format.mapfile.reader import read_map
from triquad_format.records.region import surface_voxels
from triquad_server.settings.loading import load_settings
from triquad_tools.commands.map_recording import main
from triquad_tools.console.command import ToolError
from triquad_tools.mapping.batch.batch_run import BatchRun
from triquad_tools.mapping.batch.job import place_of
from triquad_tools.mapping.batch.workers import opened
from triquad_tools.recordings.folders.cloud_folder import read_cloud_folder
from triquad_tools.recordings.opening import Selection
from triquad_tools.recordings.recording import ReadingOptions

from bench.clients.server_process import free_endpoint

COUNT = 12
EACH_M = 4.0  # through regions of 24 m
SETTINGS = str(servers.SMALL_FILE)
SPHERE = servers.sphere(2000)


def write_drive(path: Path, first: int, last: int) -> None:
    """A drive along x, from sphere to sphere."""
    poses = np.tile(np.eye(4), (last - first, 1, 1))
    poses[:, 0, 3] = EACH_M * np.arange(first, last)
    stamps = [10**18 + number * 10**8 for number in range(first, last)]
    write_folder(path, [SPHERE] * (last - first), poses, stamps)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "scans"
    write_drive(path, 0, COUNT)
    return path


@pytest.fixture(scope="module")
def whole(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the recording, made by one process."""
    path = tmp_path_factory.mktemp("whole") / "whole.triquad"
    assert main([str(recording), str(path), "--settings", SETTINGS]) == 0
    return path


@pytest.fixture(scope="module")
def workers() -> Iterator[Client]:
    """Two processes of this machine."""
    with opened(None, 2) as client:
        yield client


def run_of(client: Client, recording: Path, folder: Path, *chosen: str) -> BatchRun:
    scans = read_cloud_folder(recording, ReadingOptions())
    selection = Selection(scans, range(COUNT), 0.0, (0.0, 0.0, 0.0), "all")
    folder.mkdir(exist_ok=True)
    place = place_of(selection, load_settings(servers.SMALL_FILE, chosen))
    return BatchRun(client, selection, place, folder)


def assert_same_map(ours: Path, theirs: Path) -> None:
    """The same regions and evidence, and the same distances within the noise of training."""
    own, other = read_map(ours), read_map(theirs)
    assert len(own.regions) > 2
    assert own.progress.scans_taken == other.progress.scans_taken == COUNT
    of_other = {region.index: region for region in other.regions}
    assert {region.index for region in own.regions} == set(of_other)
    for region in own.regions:
        same = vars(of_other[region.index].evidence)
        for name, value in vars(region.evidence).items():
            np.testing.assert_array_equal(value, same[name], err_msg=name)
    places = np.linspace(-2.0, EACH_M * COUNT, 300)[:, None] * [1.0, 0.0, 0.0]
    points = (places + SPHERE[:300]).astype(np.float64)  # across all borders
    with open_map(ours) as one, open_map(theirs) as another:
        first, second = one.query_sdf(points), another.query_sdf(points)
    np.testing.assert_array_equal(first.status, second.status)
    near = np.abs(second.sdf) < 0.2
    assert near.sum() > 50
    assert np.median(np.abs(first.sdf - second.sdf)[near]) < 0.03


def test_workers_make_the_map_that_one_process_makes(
    recording: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out.triquad"
    assert main([str(recording), str(output), "--settings", SETTINGS, "--workers", "2"]) == 0
    assert "regions, epoch 1" in capsys.readouterr().out
    assert_same_map(output, whole)
    assert [path.name for path in tmp_path.iterdir()] == ["out.triquad"]


def test_recordings_of_one_frame_make_one_map(whole: Path, tmp_path: Path) -> None:
    write_drive(tmp_path / "first", 0, 5)
    write_drive(tmp_path / "second", 5, COUNT)
    parts = [str(tmp_path / "first"), str(tmp_path / "second")]
    for name, flags in {"workers": ["--workers", "1"], "alone": []}.items():
        output = tmp_path / f"{name}.triquad"
        assert main([*parts, str(output), "--settings", SETTINGS, *flags]) == 0
        assert_same_map(output, whole)


def test_a_worker_that_is_killed_loses_nothing(
    recording: Path, workers: Client, whole: Path, tmp_path: Path
) -> None:
    parts = tmp_path / "parts"
    run = run_of(workers, recording, parts, "training.samples_per_ray=100")
    pids = workers.run(os.getpid)
    results, before = [], {*pids.values()}
    thread = threading.Thread(target=lambda: results.append(run.record()))
    thread.start()
    servers.until(lambda: bool(list(parts.glob("region*"))))
    busy = next(worker for worker, tasks in workers.processing().items() if tasks)
    os.kill(pids[busy], signal.SIGKILL)
    thread.join()
    (record,) = results
    assert {one.index for one in record.regions} == {one.index for one in read_map(whole).regions}
    assert record.progress.scans_taken == COUNT
    servers.until(lambda: len(workers.scheduler_info()["workers"]) == 2)
    assert len(before & {*workers.run(os.getpid).values()}) == 1


def test_a_scheduler_that_is_gone_is_told(recording: Path, tmp_path: Path) -> None:
    port = free_endpoint().rpartition(":")[2]
    address = f"tcp://127.0.0.1:{port}"
    module = [sys.executable, "-m"]
    with (
        ended([*module, "distributed.cli.dask_scheduler", "--port", port]) as scheduler,
        ended([*module, "distributed.cli.dask_worker", address, "--nthreads", "1"]),
        Client(address, timeout=servers.WAIT_S) as client,
    ):
        client.wait_for_workers(1, timeout=servers.WAIT_S)
        run = run_of(client, recording, tmp_path / "parts", "training.samples_per_ray=100")
        with ThreadPoolExecutor() as threads:
            record = threads.submit(run.record)
            servers.until(lambda: any(client.processing().values()))
            scheduler.kill()
            with pytest.raises(ToolError, match="the scheduler of Dask is gone"):
                record.result()


@contextmanager
def ended(command: list[str]) -> "Iterator[subprocess.Popen[bytes]]":
    """A process that is ended in the end."""
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.kill()


def test_what_is_done_is_not_done_again(recording: Path, workers: Client, tmp_path: Path) -> None:
    folder = tmp_path / "parts"
    first = run_of(workers, recording, folder).record()
    done = {path: path.stat().st_mtime_ns for path in folder.glob("region*")}
    again, *others = done
    again.unlink()
    second = run_of(workers, recording, folder).record()
    assert {path: path.stat().st_mtime_ns for path in others} == {
        path: done[path] for path in others
    }
    assert [one.index for one in first.regions] == [one.index for one in second.regions]


def test_what_was_made_of_other_poses_is_not_used(
    recording: Path, workers: Client, tmp_path: Path
) -> None:
    scans, folder = tmp_path / "scans", tmp_path / "parts"
    shutil.copytree(recording, scans)
    before = run_of(workers, scans, folder).record()
    poses = np.loadtxt(scans / "poses.txt").reshape(-1, 3, 4)
    poses[:, 1, 3] += 1.0  # metres to the left
    np.savetxt(scans / "poses.txt", poses.reshape(-1, 12))
    after = run_of(workers, scans, folder).record()
    middles = [surface_voxels(one).mean(axis=0) for one in (before, after)]
    np.testing.assert_allclose(middles[1] - middles[0], [0.0, 1.0, 0.0], atol=0.1)


def test_two_runs_on_one_cluster_do_not_meet(
    recording: Path, workers: Client, tmp_path: Path
) -> None:
    runs = [run_of(workers, recording, tmp_path / name) for name in ("one", "other")]
    with ThreadPoolExecutor() as threads:
        records = list(threads.map(BatchRun.record, runs))
    assert all(len(record.regions) > 2 for record in records)
    for name in ("one", "other"):
        assert len(list((tmp_path / name).glob("region*"))) == len(records[0].regions)


def test_a_bag_is_mapped_as_a_folder(whole: Path, tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, 0, 3] = EACH_M * np.arange(COUNT)
    stamps = [10**18 + number * 10**8 for number in range(COUNT)]
    messages = drive(messages_for("mcap"), [SPHERE] * COUNT, poses, stamps, np.eye(4))
    bag, output = write_bag(tmp_path / "bag", "mcap", messages), tmp_path / "bag.triquad"
    assert main([str(bag), str(output), "--settings", SETTINGS, "--workers", "2"]) == 0
    ours, theirs = ({r.index: r.evidence for r in read_map(one).regions} for one in (output, whole))
    assert ours.keys() == theirs.keys()
    for index, evidence in ours.items():
        np.testing.assert_array_equal(evidence.surface, theirs[index].surface)


def test_poses_that_go_on_in_another_frame_are_told(
    workers: Client, recording: Path, tmp_path: Path
) -> None:
    scans = tmp_path / "scans"
    shutil.copytree(recording, scans)
    poses = np.loadtxt(scans / "poses.txt").reshape(-1, 3, 4)
    poses[8:, 0, 3] += 5e5  # metres
    np.savetxt(scans / "poses.txt", poses.reshape(-1, 12))
    with pytest.raises(ToolError, match="scan 9: .* map what is before by --end"):
        run_of(workers, scans, tmp_path / "parts").record()


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--workers", "2", "--cluster", "tcp://127.0.0.1:1"], "--workers are processes of this"),
        (["--workers", "0"], "0"),
        (["--workers", "2", "--train-for", "5"], "leave out --device and --train-for"),
        (["--cluster", "tcp://127.0.0.1:1"], "no scheduler of Dask answers at tcp://127.0.0.1:1"),
        (["--cluster", "nowhere"], "no scheduler of Dask answers at nowhere"),
    ],
)
def test_workers_that_cannot_be_had_are_told(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: list[str], told: str
) -> None:
    try:
        code = main([str(recording), str(tmp_path / "out.triquad"), *flags])
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_recording_without_a_scan_that_can_be_used_is_told(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(recording), str(tmp_path / "out.triquad"), "--range-min", "50"]
    assert main([*words, "--workers", "1"]) == 2
    assert "nothing was mapped: no scan can be used" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_poses_of_odometry_are_not_in_one_frame(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twice = [str(recording), str(recording)]
    assert main([*twice, str(tmp_path / "out.triquad"), "--odometry"]) == 2
    assert "a frame of its own: map them one by one" in capsys.readouterr().err
