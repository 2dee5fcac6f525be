"""Epochs of any size: a map goes on from large ones, and not from those that nobody counted."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support import servers
from support.files.mapfile_edit import write_record
from triquad_format.records.region import MapRecord
from triquad_server.errors import StoreError
from triquad_server.settings import StoreSettings
from triquad_server.store.restore import MAX_EPOCH
from triquad_server.store.store import Store


def write_checkpoint(store: Path, epoch: int) -> None:
    folder = store / servers.MAP
    folder.mkdir(parents=True)
    record = MapRecord(servers.MAP, epoch, servers.SMALL.field, ())
    write_record(folder / f"epoch-{epoch:09d}.triquad", record)


@pytest.mark.parametrize("epoch", [2**31 - 1, MAX_EPOCH - 1])
def test_a_map_goes_on_from_large_epochs(tmp_path: Path, epoch: int) -> None:
    write_checkpoint(tmp_path, epoch)
    with servers.service_and_client(store=tmp_path) as client:
        assert client.status().epoch == epoch
        client.publish_scan(servers.sphere(), np.eye(4))
        client.flush(30.0)
        assert client.query_sdf(servers.sphere(10)).epoch > epoch
        assert all(box.epoch > epoch for box in client.changes(since=epoch).boxes)
        client.settle(30.0)
        assert client.mesh().faces.size
        assert client.checkpoint().epoch > epoch
        assert client.reset().epoch > epoch


@pytest.mark.parametrize("epoch", [MAX_EPOCH, 2**63 - 2])
def test_an_epoch_that_no_server_counted_to_is_refused(tmp_path: Path, epoch: int) -> None:
    write_checkpoint(tmp_path, epoch)
    with (
        closing(Store(tmp_path, servers.MAP, StoreSettings())) as store,
        pytest.raises(StoreError, match=f"holds epoch {epoch}, and no map can go on.*move"),
    ):
        store.newest()
