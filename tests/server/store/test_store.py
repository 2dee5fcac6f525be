import errno
import logging
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support import servers
from triquad_format.errors import TooLargeMapFileError
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_server.errors import StoreError
from triquad_server.settings import StoreSettings
from triquad_server.store import restore
from triquad_server.store.restore import MAX_EPOCH
from triquad_server.store.store import Store


def record(epoch):
    return MapRecord("lab", epoch, servers.SMALL.field, ()), (), {}


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path, "lab", StoreSettings(keep=2))
    yield store
    store.close()


def names(store):
    others = ("lock", "parts")
    return sorted(path.name for path in store.folder.iterdir() if path.name not in others)


def test_the_newest_checkpoints_are_kept_and_described_and_other_files_left_alone(store):
    (store.folder / "notes.txt").write_text("mine")
    for epoch in (0, 1, 2, 10):
        info = store.write(*record(epoch))
    newest = ["epoch-000000002.checkpoint", "epoch-000000010.checkpoint"]
    assert names(store) == [*newest, "notes.txt"]
    restored = store.newest()
    assert restored.record.epoch == restored.info.epoch == 10
    assert restored.info == info
    assert info.bytes == (store.folder / "epoch-000000010.checkpoint").stat().st_size  # no parts
    assert len(info.sha256) == 64


def test_a_damaged_checkpoint_is_left_out_by_name_and_kept_aside(store, caplog):
    store.write(*record(1))
    bad = store.folder / "epoch-000000002.checkpoint"
    bad.write_bytes(b"not a map")
    with caplog.at_level(logging.WARNING):
        assert store.newest().record.epoch == 1
    assert "epoch-000000002.checkpoint is damaged" in caplog.text
    assert "epoch-000000001.checkpoint is used instead" in caplog.text
    assert names(store) == ["epoch-000000001.checkpoint", "epoch-000000002.checkpoint.damaged"]
    store.write(*record(2))
    store.write(*record(3))
    assert store.newest().record.epoch == 3


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EIO, "Input/output error"),
        OSError(errno.EMFILE, "Too many open files"),
        PermissionError(errno.EACCES, "Permission denied"),
        TooLargeMapFileError("it is larger than the limit"),
    ],
)
def test_a_valid_checkpoint_that_cannot_be_read_now_is_not_demoted(store, monkeypatch, error):
    for epoch in (1, 2):
        store.write(*record(epoch))
    before = names(store)

    def fail(path):
        raise error

    monkeypatch.setattr(restore, "read_checkpoint", fail)
    with pytest.raises(StoreError, match="000000002.checkpoint cannot be read"):
        store.newest()
    assert names(store) == before


def test_a_damaged_file_of_a_higher_number_does_not_push_out_a_valid_one(store):
    store.write(*record(1))
    for epoch in (8, 9):
        (store.folder / f"epoch-00000000{epoch}.checkpoint").write_bytes(b"damaged")
    store.write(*record(2))
    assert names(store)[:2] == ["epoch-000000001.checkpoint", "epoch-000000002.checkpoint"]
    store.write(*record(3))
    assert names(store)[:2] == ["epoch-000000002.checkpoint", "epoch-000000003.checkpoint"]
    assert store.newest().record.epoch == 3


def test_what_a_killed_server_left_unfinished_goes(store, tmp_path):
    store.write(*record(1))
    store.close()
    (store.folder / ".epoch-000000002.checkpoint.0a1b2c3d.tmp").write_bytes(b"half")
    with closing(Store(tmp_path, "lab", StoreSettings(keep=2))) as again:
        assert names(again) == ["epoch-000000001.checkpoint"]
        assert again.newest().record.epoch == 1


def test_an_epoch_of_another_map_is_told_with_the_maps_there_are(store, tmp_path):
    store.write(*record(3))
    with (
        closing(Store(tmp_path, "default", StoreSettings())) as forgotten,
        pytest.raises(StoreError, match="the store has checkpoints of lab: name the map by --map"),
    ):
        forgotten.restore(3)
    with pytest.raises(StoreError, match="there are: 3$"):
        store.restore(4)


def test_a_checkpoint_under_a_wrong_number_does_not_pass_for_a_later_one(store, caplog):
    store.write(*record(3))
    valid = store.folder / "epoch-000000003.checkpoint"
    (store.folder / "epoch-000000009.checkpoint").write_bytes(valid.read_bytes())
    with caplog.at_level(logging.WARNING):
        restored = store.newest()
    assert restored.info.epoch == restored.record.epoch == 3
    assert "epoch-000000009.checkpoint holds epoch 3" in caplog.text
    store.write(*record(4))
    assert store.newest().record.epoch == 4


def write_checkpoint(store: Path, epoch: int) -> None:
    folder = store / servers.MAP
    folder.mkdir(parents=True)
    record = MapRecord(servers.MAP, epoch, servers.SMALL.field, ())
    write_map(record, folder / f"epoch-{epoch:09d}.triquad")


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
