"""A bit that rots in the base of later checkpoints is found while the map is still in memory."""

from pathlib import Path

import numpy as np
import triquad_client
from support import servers
from triquad_format.mapfile.checkpoint_folder import checkpoint_files
from triquad_format.mapfile.reader import read_map

HALF_A_SECOND_H = 0.5 / 3600


def rot(path: Path) -> None:
    """Flip a bit in the middle of a file, whose time stays: as a disk does it."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    with path.open("r+b") as file:
        file.write(data)


def test_a_base_that_rots_is_written_anew(tmp_path: Path) -> None:
    settings = tmp_path / "server.toml"
    settings.write_text(servers.SMALL_TOML + f"[store]\nscrub_h = {HALF_A_SECOND_H}\n")
    arguments = ["--settings", settings, "--store", tmp_path / "store"]
    far = np.eye(4)
    far[0, 3] = 75.0
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        for place in range(4):
            pose = np.eye(4)
            pose[0, 3] = 25.0 * place
            client.publish_scan(servers.sphere(), pose)
        client.flush(servers.WAIT_S)
        client.settle(servers.WAIT_S)
        base = Path(client.checkpoint().path)
        client.publish_scan(servers.sphere(3000), far)
        client.flush(servers.WAIT_S)
        client.settle(servers.WAIT_S)
        newest = client.checkpoint()
        assert newest.path.endswith(".delta.triquad")
        server.wait_for("checkpoints on disk")
        before = client.query_sdf(servers.sphere(200))
        rot(base)
        server.wait_for(f"bit rot: {base} is damaged")
        server.wait_for("all of the map is written anew")
        server.wait_for(f"checkpoint {base.parent}")
        server.process.kill()
        server.wait()
    newest_file = checkpoint_files(base.parent)[0]
    assert newest_file.complete
    assert newest_file.epoch >= newest.epoch
    read_map(newest_file.path)
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        assert np.array_equal(client.query_sdf(servers.sphere(200)).status, before.status)
