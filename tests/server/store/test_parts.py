"""Parts are kept once, and as long as a checkpoint names them."""

import dataclasses
import logging
from contextlib import closing
from pathlib import Path

import pytest
from support.files.file_damage import rot
from support.files.growing_store import (
    ROW,
    changes,
    drive,
    grown,
    part_of,
    parts_of,
    paths,
)
from support.maps.map_records import assert_same, random_record
from triquad_format.errors import DamagedMapFileError, MapFileError, RefusedError
from triquad_format.mapfile.checkpoint_folder import PartFiles, checkpoint_files
from triquad_format.mapfile.reader import open_manifest, read_map
from triquad_format.mapfile.writer import write_map
from triquad_server.errors import StoreError
from triquad_server.settings import StoreSettings
from triquad_server.store.retention import delete_unneeded
from triquad_server.store.store import Store
from triquad_tools.mapfiles.recovery import recover


@pytest.fixture
def store(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=100))) as store:
        yield store


def test_a_checkpoint_writes_what_changed_and_reads_back_whole(store):
    records = drive(store, 3)
    found = paths(store)
    assert [found[epoch].name for epoch in records] == [
        f"epoch-00000000{epoch}.checkpoint" for epoch in (1, 2, 3, 4)
    ]
    for epoch, record in records.items():
        assert_same(read_map(found[epoch]), record)
    first = parts_of(found[1])
    for epoch in (2, 3, 4):
        new = parts_of(found[epoch]) - parts_of(found[epoch - 1])
        assert 0 < len(new) <= len(first) / len(ROW)


def test_what_did_not_change_is_neither_encoded_nor_written(store, monkeypatch):
    first = grown(1, 1)
    store.write(*changes(first))
    before = {path: path.stat() for path in parts_of(paths(store)[1])}
    monkeypatch.setattr("triquad_format.mapfile.checkpoint_folder.compressed", None)
    store.write(*changes(dataclasses.replace(first, epoch=2), only=ROW[:3]))
    assert {path: path.stat() for path in parts_of(paths(store)[2])} == before
    assert_same(read_map(paths(store)[2]), dataclasses.replace(first, epoch=2))


def test_a_restarted_store_goes_on_from_the_newest(store, tmp_path):
    records = drive(store, 2)
    store.close()
    with closing(Store(tmp_path, "lab", StoreSettings(keep=100))) as again:
        assert again.base_epoch is None
        restored = again.newest()
        assert restored is not None
        assert_same(read_map(restored.path), records[3])
        assert again.base_epoch == 3
        fourth = grown(4, 4, records[3], ROW[:1])
        info = again.write(*changes(fourth, ROW[:1]))
        assert_same(read_map(info.path), fourth)


def test_a_backup_is_restored_and_gone_on_from(store):
    first = grown(1, 7)
    write_map(first, store.folder / "epoch-000000007.triquad")
    restored = store.newest()
    assert restored is not None
    assert_same(read_map(restored.path), first)
    assert store.base_epoch is None, "its parts are not in the store"
    store.write(*changes(grown(2, 8)))
    store.restore(7)
    assert_same(read_map(store.newest().path), dataclasses.replace(first, epoch=9))
    assert store.base_epoch == 9


# Damage, and what others do to the folder


@pytest.mark.parametrize("harm", ["delete", "cut", "delete the checkpoint", "cut the checkpoint"])
def test_where_something_is_gone_all_is_written_again(store, harm):
    records = drive(store, 1)
    path = paths(store)[2] if "checkpoint" in harm else part_of(paths(store)[2], ROW[0])
    if "delete" in harm:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-1])
    assert store.base_epoch is None
    third = dataclasses.replace(records[2], epoch=3)  # the same map
    store.write(*changes(third))
    assert_same(read_map(paths(store)[3]), third)
    assert store.base_epoch == 3, "later ones are of what changed"
    fourth = grown(4, 4, third, ROW[:1])
    store.write(*changes(fourth, ROW[:1]))
    assert_same(read_map(paths(store)[4]), fourth)


@pytest.mark.parametrize("read", [read_map, recover])
def test_a_checkpoint_that_is_deleted_while_it_is_read_is_not_called_damaged(
    store, read, monkeypatch
):
    drive(store, 0)
    path = paths(store)[1]
    payload = PartFiles.payload

    def deleting(self, entry):
        path.unlink(missing_ok=True)
        (self.folder / entry.name).unlink(missing_ok=True)
        return payload(self, entry)

    monkeypatch.setattr(PartFiles, "payload", deleting)
    with pytest.raises(MapFileError, match="deleted this checkpoint.*open a newer one") as caught:
        read(path)
    assert "recover" not in str(caught.value)


def test_a_part_that_nothing_new_needs_is_no_reason_to_write(store):
    first = grown(1, 1)
    store.write(*changes(first))
    part = part_of(paths(store)[1], ROW[0])
    store.write(*changes(grown(2, 2)))
    assert not store.forget_base(part.name)
    assert store.base_epoch == 2


def test_another_part_under_a_name_is_found_out(store):
    drive(store, 1)
    one, other = (part_of(paths(store)[2], index) for index in ROW[:2])
    one.write_bytes(other.read_bytes())
    with pytest.raises(DamagedMapFileError, match=one.name):
        read_map(paths(store)[2])


def test_an_older_checkpoint_serves_where_the_newest_is_damaged(store, caplog):
    records = drive(store, 2)
    paths(store)[3].write_bytes(b"not a checkpoint")
    with caplog.at_level(logging.WARNING):
        restored = store.newest()
    assert restored is not None
    assert_same(read_map(restored.path), records[2])
    assert "epoch-000000002.checkpoint is used instead" in caplog.text
    store.write(*changes(records[3]))
    assert_same(read_map(paths(store)[3]), records[3])


def test_where_all_parts_are_gone_a_checkpoint_is_damaged(store):
    drive(store, 2)
    for part in parts_of(paths(store)[3]) | parts_of(paths(store)[1]) | parts_of(paths(store)[2]):
        part.unlink()
    with pytest.raises(StoreError, match="all 3 checkpoints .* are damaged"):
        store.newest()


def test_no_part_of_a_region_is_read_before_it_is_asked_about(store, monkeypatch):
    """So the start takes as long for any map."""
    drive(store, 2)
    monkeypatch.setattr(PartFiles, "payload", None)
    restored = store.newest()
    assert restored.record.regions == ()
    assert store.regions.known.keys() == restored.regions.keys() == set(ROW)


@pytest.mark.parametrize("harm", [rot, Path.unlink], ids=["rotten", "missing"])
def test_a_region_is_read_from_an_older_checkpoint_where_a_part_is_damaged(store, harm, caplog):
    """And the next checkpoint has it like that."""
    records = drive(store, 3)
    harm(part_of(paths(store)[4], ROW[3]))  # which changed in epoch 3
    store.newest()
    older, intact = (store.regions.known[index].whole() for index in (ROW[3], ROW[4]))
    assert_same(older, records[2].regions[3])
    assert_same(intact, records[4].regions[4])
    assert f"region {ROW[3]} is used as of epoch 2 instead" in caplog.text
    fifth = dataclasses.replace(records[4], epoch=5)
    info = store.write(*changes(fifth, ROW[:1]))
    regions = [older if one.index == ROW[3] else one for one in fifth.regions]
    assert_same(read_map(info.path), dataclasses.replace(fifth, regions=tuple(regions)))


def test_an_old_state_of_a_region_is_not_taken_for_a_newer_one(store):
    records = drive(store, 1)
    store.newest()
    old = store.regions.known[ROW[2]]
    store.write(*changes(grown(3, 3, records[2], ROW[2:3]), ROW[2:3]))
    for entry in set(old.entries) - set(store.regions.known[ROW[2]].entries):
        (store.folder / "parts" / entry.name).unlink()
    with pytest.raises(RefusedError, match="epoch_gone"):
        old.whole()


def test_a_region_of_which_all_states_are_rotten_is_refused_by_name(store):
    drive(store, 1)
    rot(part_of(paths(store)[2], ROW[3]))  # of both checkpoints
    store.newest()
    with pytest.raises(RefusedError, match=r"region \(3, 0, 0\) cannot be read.*reset its box"):
        store.regions.known[ROW[3]].whole()
    assert store.regions.known[ROW[2]].evidence.levels.size


def test_what_was_set_aside_can_still_be_recovered(store):
    records = drive(store, 2)
    part_of(paths(store)[3], ROW[3], "/triquad/region").unlink()
    paths(store)[3].rename(f"{paths(store)[3]}.damaged")
    assert store.newest().record.epoch == 2
    for epoch in (4, 5):
        store.write(*changes(grown(epoch, epoch)))
    (aside,) = store.folder.glob("*.damaged")
    saved = recover(aside)
    assert saved.record.epoch == 3
    kept = [region for region in records[3].regions if region.index != ROW[3]]
    assert_same(saved.record, dataclasses.replace(records[3], regions=tuple(kept)))


def test_what_could_not_be_read_again_is_not_written(store, monkeypatch):
    drive(store, 1)
    before = sorted(store.folder.rglob("*"))
    manifests = [open_manifest(file) for file in checkpoint_files(store.folder)]
    most = max(sum(entry.size for entry in one.entries) for one in manifests) + 1000
    monkeypatch.setattr("triquad_format.mapfile.index.MAX_CHECKPOINT_BYTES", most)
    larger = dataclasses.replace(random_record(3, indices=ROW, name="lab", points=300), epoch=3)
    message = f"000000003.checkpoint cannot be written: .* limit of {most} bytes"
    with pytest.raises(StoreError, match=message):
        store.write(*changes(larger))
    assert sorted(store.folder.rglob("*")) == before


def test_parts_stay_where_a_checkpoint_needs_a_newer_release(store, monkeypatch, caplog):
    """Which parts it names is not known."""
    drive(store, 2)
    everything = set(store.folder.rglob("*"))
    monkeypatch.setattr("triquad_format.mapfile.metadata.FORMAT_VERSION", 0)
    delete_unneeded(store.folder, StoreSettings(keep=2), store.epoch)
    assert set(store.folder.rglob("*")) == everything
    assert "stay, needed or not" in caplog.text


def test_whoever_deletes_the_lock_lets_nobody_else_in(store, tmp_path):
    store.write(*changes(grown(1, 1)))
    (store.folder / "lock").unlink()
    store.write(*changes(grown(2, 2)))
    with pytest.raises(StoreError, match="in use by another server"):
        Store(tmp_path, "lab", StoreSettings(keep=2))
    (store.folder / "lock").unlink()
    with (
        closing(Store(tmp_path, "lab", StoreSettings(keep=2))),
        pytest.raises(StoreError, match="in use by another server"),
    ):
        store.write(*changes(grown(3, 3)))
    store.write(*changes(grown(3, 3)))


@pytest.mark.parametrize("clock_ns", [-(10**18), 2**63])
def test_no_clock_keeps_a_checkpoint_from_being_written(store, monkeypatch, clock_ns):
    monkeypatch.setattr("time.time_ns", lambda: clock_ns)
    store.write(*changes(grown(1, 1)))
    assert read_map(paths(store)[1]).epoch == 1
