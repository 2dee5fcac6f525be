import dataclasses
import os
from contextlib import closing
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from support.map_records import assert_same, random_record
from triquad_format.errors import DamagedMapFileError
from triquad_format.mapfile.checkpoint_folder import checkpoint_at, checkpoint_files
from triquad_format.mapfile.reader import read_map, read_map_file
from triquad_format.records.field_settings import RegionIndex
from triquad_format.recovery.recovered_map import recover
from triquad_server.errors import StoreBaseError, StoreError
from triquad_server.mapping.map_snapshot import MapChanges
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings, StoreSettings
from triquad_server.store.store import Store

ROW: tuple[RegionIndex, ...] = tuple((x, 0, 0) for x in range(10))


def grown(seed, epoch, before=None, only=ROW):
    """A map of ten regions; those not in ``only`` are as in ``before``."""
    fresh = random_record(seed, indices=ROW, name="lab", epoch=epoch, points=60)
    if before is None:
        return fresh
    old = {region.index: region for region in before.regions}
    regions = tuple(r if r.index in only else old[r.index] for r in fresh.regions)
    return dataclasses.replace(fresh, regions=regions)


def changes(record, only=ROW):
    """What the mapper hands over where the regions ``only`` changed."""
    changed = tuple(region for region in record.regions if region.index in only)
    epoch = Mapper("lab", Settings(field=record.settings), "cpu", record).publish()
    return MapChanges(
        dataclasses.replace(record, regions=changed),
        tuple(region.index for region in record.regions),
        epoch,
    )


@pytest.fixture
def store(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=100))) as store:
        yield store


def drive(store, epochs, rows=ROW):
    """Epochs of which each changes the next one of the regions ``rows``; the first is complete."""
    records = {1: grown(1, 1)}
    store.write(changes(records[1]))
    for epoch in range(2, 2 + epochs):
        only = (rows[epoch % len(rows)],)
        record = grown(epoch, epoch, records[max(records)], only)
        store.write(changes(record, only))
        records[epoch] = record
    return records


def paths(store):
    return {file.epoch: file.path for file in reversed(checkpoint_files(store.folder))}


def test_a_checkpoint_holds_what_changed_and_reads_back_whole(store):
    records = drive(store, 3)
    found = paths(store)
    assert [found[epoch].name for epoch in records] == [
        "epoch-000000001.triquad",
        "epoch-000000002.delta.triquad",
        "epoch-000000003.delta.triquad",
        "epoch-000000004.delta.triquad",
    ]
    for epoch, record in records.items():
        assert_same(read_map(found[epoch]), record)
    whole = found[1].stat().st_size
    assert all(found[epoch].stat().st_size < 2 * whole / len(ROW) for epoch in (2, 3, 4))


def test_parts_keep_the_epoch_in_which_they_changed(store):
    drive(store, 3)
    manifest = read_map_file(paths(store)[4]).manifest
    assert manifest is not None
    changed = {e.key.region: e.epoch for e in manifest.entries if e.key.topic == "/triquad/region"}
    assert changed == {index: 1 for index in ROW} | {ROW[2]: 2, ROW[3]: 3, ROW[4]: 4}


def test_where_most_changed_the_checkpoint_needs_no_other(store):
    first = grown(1, 1)
    store.write(changes(first))
    second = grown(2, 2, first, ROW[:6])
    store.write(changes(second, ROW[:6]))
    assert paths(store)[2].name == "epoch-000000002.triquad"
    paths(store)[1].unlink()
    assert_same(read_map(paths(store)[2]), second)


def test_a_restarted_store_goes_on_with_deltas(store, tmp_path):
    records = drive(store, 2)
    store.close()
    with closing(Store(tmp_path, "lab", StoreSettings(keep=100))) as again:
        assert again.base_epoch is None
        restored = again.newest()
        assert restored is not None
        assert_same(restored.record, records[3])
        assert again.base_epoch == 3
        fourth = grown(4, 4, records[3], ROW[:1])
        info = again.write(changes(fourth, ROW[:1]))
        assert info.path.endswith("epoch-000000004.delta.triquad")
        assert_same(read_map(info.path), fourth)


def test_regions_that_were_reset_are_gone(store):
    first = grown(1, 1)
    store.write(changes(first))
    second = dataclasses.replace(first, epoch=2, regions=first.regions[:3])
    store.write(changes(second, only=()))
    assert_same(read_map(paths(store)[2]), second)


def test_a_base_that_vanished_makes_the_next_checkpoint_complete(store):
    drive(store, 1)
    paths(store)[1].unlink()
    assert store.base_epoch is None
    third = grown(3, 3)
    store.write(changes(third))
    assert_same(read_map(paths(store)[3]), third)


def corrupt(path):
    """Overwrite the middle of a file, and put its time back."""
    before = path.stat()
    data = path.read_bytes()
    path.write_bytes(data[:2000] + bytes(len(data) - 4000) + data[-2000:])
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def rot(store, path):
    """Damage a file as a disk does: nothing but its bytes tells."""
    corrupt(path)
    store._files.record([path.name])


def test_after_its_base_was_corrupted_a_checkpoint_is_complete(store):
    first = grown(1, 1)
    store.write(changes(first))
    corrupt(paths(store)[1])
    assert store.base_epoch is None
    second = grown(2, 2)
    store.write(changes(second))
    assert_same(read_map(paths(store)[2]), second)


def test_a_damaged_base_is_not_copied_from(store):
    """What is damaged must not be written again as if it were valid; then all is asked for."""
    first = grown(1, 1)
    store.write(changes(first))
    rot(store, paths(store)[1])
    assert store.base_epoch == 1
    second = grown(2, 2, first, ROW[:7])
    with pytest.raises(StoreBaseError, match="epoch-000000001.triquad"):
        store.write(changes(second, ROW[:7]))
    assert list(paths(store)) == [1]
    assert store.base_epoch is None
    third = grown(3, 3)
    store.write(changes(third))
    assert_same(read_map(paths(store)[3]), third)


def test_a_damaged_base_is_found_when_folding(store):
    drive(store, 9)
    rot(store, paths(store)[1])
    rot(store, paths(store)[5])
    with pytest.raises(StoreBaseError, match="cannot be folded"):
        store.fold(lambda: False)
    assert store.base_epoch is None


def test_a_valid_delta_serves_where_the_complete_file_of_its_epoch_is_damaged(store):
    records = drive(store, 2)
    (store.folder / "epoch-000000003.triquad").write_bytes(b"half a fi")
    restored = store.newest()
    assert restored is not None
    assert_same(restored.record, records[3])


def test_whoever_deletes_the_lock_lets_nobody_else_in(store, tmp_path):
    store.write(changes(grown(1, 1)))
    (store.folder / "lock").unlink()
    store.write(changes(grown(2, 2)))
    with pytest.raises(StoreError, match="in use by another server"):
        Store(tmp_path, "lab", StoreSettings(keep=2))
    (store.folder / "lock").unlink()
    with (
        closing(Store(tmp_path, "lab", StoreSettings(keep=2))),
        pytest.raises(StoreError, match="in use by another server"),
    ):
        store.write(changes(grown(3, 3)))
    store.write(changes(grown(3, 3)))


@pytest.mark.parametrize("clock_ns", [-(10**18), 2**63])
def test_no_clock_keeps_a_checkpoint_from_being_written(store, monkeypatch, clock_ns):
    monkeypatch.setattr("time.time_ns", lambda: clock_ns)
    store.write(changes(grown(1, 1)))
    assert read_map(paths(store)[1]).epoch == 1


def test_what_is_no_file_does_not_stop_the_retention(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=2))) as store:
        (store.folder / "epoch-000000000.triquad").mkdir()
        os.mkfifo(store.folder / "epoch-000000000.delta.triquad")
        (store.folder / "epoch-000000001.triquad").symlink_to("nowhere")
        for epoch in range(2, 6):
            store.write(changes(grown(epoch, epoch)))
        assert sorted(paths(store)) == [4, 5]


def test_without_its_base_a_delta_is_damaged_by_name(store):
    drive(store, 1)
    paths(store)[1].unlink()
    with pytest.raises(DamagedMapFileError, match="epoch-000000001.triquad, which holds parts"):
        read_map(paths(store)[2])


def test_another_file_under_the_name_of_the_base_is_found_out(store):
    drive(store, 1)
    other = Store(store.folder.parent, "other", StoreSettings(keep=2))
    with closing(other):
        other.write(changes(grown(9, 1)))
        paths(store)[1].write_bytes(paths(other)[1].read_bytes())
    with pytest.raises(
        DamagedMapFileError, match="epoch-000000001.triquad, .* is not the part listed"
    ):
        read_map(paths(store)[2])


def test_folding_puts_all_into_one_file(store):
    records = drive(store, 9)
    newest = max(records)
    info = store.fold(lambda: False)
    assert info is not None
    assert info.path.endswith(f"epoch-{newest:09d}.triquad")
    folded = read_map_file(info.path)
    assert_same(folded.record, records[newest])
    assert folded.manifest is not None
    assert folded.manifest.files == ()
    assert {entry.epoch for entry in folded.manifest.entries} == set(range(1, 11))
    assert store.fold(lambda: False) is None
    after = grown(77, newest + 1, records[newest], ROW[:1])
    manifest = read_map_file(store.write(changes(after, ROW[:1])).path).manifest
    assert manifest is not None
    assert manifest.files == (Path(info.path).name,)
    for epoch, record in records.items():
        assert_same(read_map(checkpoint_at(store.folder, str(epoch)).path), record)


def test_viewers_see_every_region_in_a_folded_checkpoint(store):
    drive(store, 9)
    info = store.fold(lambda: False)
    assert info is not None
    with Path(info.path).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        scenes = [found[3] for found in reader.iter_decoded_messages(topics=["/preview/mesh"])]
    names = {entity.id for scene in scenes for entity in scene.entities}
    assert names == {"region {} {} {}".format(*index) for index in ROW}


def test_folding_ends_when_the_server_does(store):
    drive(store, 9)
    before = sorted(store.folder.iterdir())
    assert store.fold(lambda: True) is None
    assert sorted(store.folder.iterdir()) == before


def test_retention_keeps_the_files_that_kept_checkpoints_need(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=3))) as store:
        records = drive(store, 5, ROW[:1])
        assert sorted(paths(store)) == [1, 4, 5, 6]
        for epoch in (4, 5, 6):
            assert_same(read_map(paths(store)[epoch]), records[epoch])
        whole = grown(7, 7)
        for epoch in (7, 8, 9):
            store.write(changes(dataclasses.replace(whole, epoch=epoch)))
        assert sorted(paths(store)) == [7, 8, 9]


def test_retention_by_bytes_counts_shared_files_once(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=100, keep_bytes=0))) as store:
        drive(store, 1)
        whole, part = (paths(store)[epoch].stat().st_size for epoch in (1, 2))
    limit = whole + 4 * part
    with closing(Store(tmp_path, "roomy", StoreSettings(keep=100, keep_bytes=limit))) as store:
        drive(store, 9, ROW[:1])
        kept = sorted(paths(store))
        assert kept[0] == 1
        assert 4 <= len(kept) <= 6
        assert sum(path.stat().st_size for path in paths(store).values()) <= limit
    with closing(Store(tmp_path, "tight", StoreSettings(keep=100, keep_bytes=1))) as store:
        drive(store, 9, ROW[:1])
        assert sorted(paths(store)) == [1, 9, 10]


def test_retention_by_age(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=100, keep_age_s=1.0))) as store:
        records = drive(store, 3, ROW[:1])
        for path in paths(store).values():
            seconds = path.stat().st_mtime - 10
            os.utime(path, (seconds, seconds))
        last = grown(9, 9, records[4], ROW[:1])
        store.write(changes(last, ROW[:1]))
        assert sorted(paths(store)) == [1, 4, 9]


def test_a_base_whose_end_is_lost_serves_until_all_is_in_another_file(store):
    records = drive(store, 3)
    base = paths(store)[1]
    base.write_bytes(base.read_bytes()[:-2000])
    restored = store.newest()
    assert restored is not None
    assert_same(restored.record, records[4])
    folded = store.fold(lambda: False)
    assert folded is not None
    base.unlink()
    assert_same(read_map(folded.path), records[4])


def test_what_was_set_aside_can_still_be_recovered_with_its_base(store):
    records = drive(store, 3)
    base = paths(store)[1]
    base.write_bytes(base.read_bytes()[: base.stat().st_size * 17 // 20])
    with pytest.raises(StoreError, match="all 4 checkpoints"):
        store.newest()
    whole = grown(5, 5)
    store.write(changes(whole))
    restored = store.newest()
    assert restored is not None
    assert_same(restored.record, whole)
    for path in paths(store).values():
        if path != paths(store)[5]:
            path.rename(path.with_name(path.name + ".damaged"))
    newest = store.folder / "epoch-000000004.delta.triquad.damaged"
    saved = recover(newest).record
    changed = {region.index: region for region in saved.regions}
    for index in ROW[2:5]:
        assert_same(changed[index], next(r for r in records[4].regions if r.index == index))


def test_who_lost_the_folder_does_not_fold_in_it(store, tmp_path):
    drive(store, 9)
    (store.folder / "lock").unlink()
    with closing(Store(tmp_path, "lab", StoreSettings(keep=100))) as other:
        assert other.newest() is not None
        with pytest.raises(StoreError, match="in use by another server"):
            store.fold(lambda: False)
        assert 10 in paths(other)


def test_damaged_files_of_one_name_are_all_set_aside(store):
    store.write(changes(grown(1, 1)))
    bad = store.folder / "epoch-000000002.triquad"
    for _ in range(3):
        bad.write_bytes(b"half a fi")
        assert store.newest().record.epoch == 1
    assert len(list(store.folder.glob("*.damaged"))) == 3
