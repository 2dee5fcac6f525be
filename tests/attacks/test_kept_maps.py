"""Neither who resets the map, on purpose or by mistake, nor a disk that rots destroys it."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import triquad_client
import triquad_server
from support import servers
from support.files.file_damage import rot
from triquad_client import Client, RefusedError
from triquad_format.mapfile.checkpoint_folder import checkpoint_files
from triquad_format.mapfile.index import Checkpoint
from triquad_format.mapfile.reader import read_map, read_map_file
from triquad_format.mapfile.writer import MapFileInfo
from triquad_server.settings import StoreSettings

ATTACKS = 14
PROBES = servers.sphere(200)


@contextmanager
def served(folder: Path, *more: str) -> Iterator[tuple[servers.ServerProcess, Client]]:
    arguments = ["--settings", servers.SMALL_FILE, "--store", folder / "store", *more]
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        yield server, client


def counts(client: Client) -> tuple[int, int]:
    """What the map was made of."""
    status = client.status()
    return status.scans_taken, status.samples_trained


def test_the_map_of_before_outlives_resets_and_checkpoints_without_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Retention keeps the newest checkpoints: those of an empty map pushed out all others."""
    caplog.set_level("INFO")
    few = servers.SMALL.model_copy(update={"store": StoreSettings(keep=3)})
    with servers.service_and_client(few, store=tmp_path / "store") as client:
        servers.learn_all(client)
        before = client.query_sdf(PROBES)
        made_of = counts(client)
        replies = []
        for number in range(ATTACKS):
            replies.append(client.reset())
            client.checkpoint()
            if number % 3 == 2:  # with something in it, which is kept in turn
                client.publish_scan(servers.sphere(300, 2.0), np.eye(4))
                client.flush(servers.WAIT_S)
                client.checkpoint()
        first = replies[0]
        assert first.kept_epoch is not None
        assert f"--restore {first.kept_epoch}" in (first.undo or "")
        assert f"--restore {first.kept_epoch}" in caplog.text
        assert client.status().regions in (0, 1)
        assert counts(client) < made_of
    with served(tmp_path, "--restore", str(first.kept_epoch)) as (server, client):
        after = client.query_sdf(PROBES)
        assert np.array_equal(after.status, before.status)
        assert np.allclose(after.sdf, before.sdf, rtol=0, atol=2e-3)
        assert counts(client) == made_of
        assert client.status().epoch > replies[-1].epoch
        learnt_since = client.status().epoch
        servers.learn(client)
        server.process.kill()  # a restart with the same arguments must not undo what follows
        server.wait()
    with served(tmp_path, "--restore", str(first.kept_epoch)) as (server, client):
        assert "was taken back to epoch" in server.log
        assert client.status().epoch >= learnt_since
        assert np.array_equal(client.query_sdf(PROBES).status, before.status)


def test_nothing_is_reset_where_the_map_cannot_be_kept_and_mapping_goes_on_while_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    servers.compiled()
    settings = StoreSettings(keep=2, period_s=0)
    small = servers.SMALL.model_copy(update={"store": settings})
    with (
        triquad_server.serve(store=tmp_path, settings=small) as server,
        server.client() as client,
        triquad_client.connect(server.endpoint) as robot,
    ):
        servers.learn(client)
        taken = []

        def fail(path: Path, checkpoint: Checkpoint) -> MapFileInfo:
            robot.publish_scan(servers.sphere(300, 2.0), np.eye(4))
            taken.append(robot.flush(servers.WAIT_S).taken)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr("triquad_server.store.store.write_checkpoint", fail)
        with pytest.raises(RefusedError, match="nothing was reset.*No space left"):
            client.reset()
        monkeypatch.undo()
        assert taken == [1]
        assert client.status().regions > 0
        reply = client.reset()
        assert client.status().regions == 0
        (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
        for _ in range(3):
            servers.learn(client, scans=1)
            client.checkpoint()
        assert reply.kept_epoch in {file.epoch for file in checkpoint_files(folder)}


def test_a_part_that_rots_is_written_again(tmp_path: Path) -> None:
    with served(tmp_path, "--set", f"store.scrub_h={0.5 / 3600}") as (server, client):
        servers.learn_all(client)
        newest = client.checkpoint()
        server.wait_for("checkpoints on disk")
        before = client.query_sdf(PROBES)
        entry = read_map_file(newest.path).manifest.entries[0]
        part = Path(newest.path).parent / "parts" / entry.name
        rot(part)
        server.wait_for(f"bit rot: {part} is damaged")
        server.wait_for("all of the map is written again")
        server.wait_for(f"checkpoint {newest.path}: ")
        server.process.kill()
        server.wait()
    assert read_map(newest.path).epoch == newest.epoch
    with served(tmp_path) as (_, client):
        assert np.array_equal(client.query_sdf(PROBES).status, before.status)
