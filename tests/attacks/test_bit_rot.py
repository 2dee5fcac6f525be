"""A bit that rots in a part of the newest checkpoint is found while the map is in memory."""

from pathlib import Path

import numpy as np
import triquad_client
from support import servers
from triquad_format.mapfile.reader import read_map, read_map_file

HALF_A_SECOND_H = 0.5 / 3600


def rot(path: Path) -> None:
    """Flip a bit in the middle of a file, whose time stays: as a disk does it."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    with path.open("r+b") as file:
        file.write(data)


def test_a_part_that_rots_is_written_again(tmp_path: Path) -> None:
    settings = tmp_path / "server.toml"
    settings.write_text(servers.SMALL_TOML + f"[store]\nscrub_h = {HALF_A_SECOND_H}\n")
    arguments = ["--settings", settings, "--store", tmp_path / "store"]
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        servers.learn(client)
        client.settle(servers.WAIT_S)
        newest = client.checkpoint()
        server.wait_for("checkpoints on disk")
        before = client.query_sdf(servers.sphere(200))
        entry = read_map_file(newest.path).manifest.entries[0]
        part = Path(newest.path).parent / "parts" / entry.name
        rot(part)
        server.wait_for(f"bit rot: {part} is damaged")
        server.wait_for("all of the map is written again")
        server.wait_for(f"checkpoint {newest.path}: ")
        server.process.kill()
        server.wait()
    assert read_map(newest.path).epoch == newest.epoch
    with (
        servers.server_process(arguments) as server,
        triquad_client.connect(server.endpoint) as client,
    ):
        assert np.array_equal(client.query_sdf(servers.sphere(200)).status, before.status)
