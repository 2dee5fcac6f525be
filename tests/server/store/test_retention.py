"""Which checkpoints stay."""

import dataclasses
import os
from contextlib import closing

from support.files.growing_store import ROW, changes, drive, grown, parts_of, paths
from support.maps.map_records import assert_same
from triquad_format.mapfile.checkpoint_folder import PartFiles
from triquad_format.mapfile.index import read_checkpoint, write_checkpoint
from triquad_format.mapfile.reader import read_map
from triquad_server.settings import StoreSettings
from triquad_server.store.retention import StoredCheckpoint, staying
from triquad_server.store.store import Store


def checkpoints(*files: str) -> list[StoredCheckpoint]:
    """One for each text, the newest first: the names of its files, and ! where it undoes a reset.

    Each file has 10 bytes.
    """
    return [
        StoredCheckpoint(
            dict.fromkeys(names.strip("!"), 10), undoes="a reset" if "!" in names else ""
        )
        for names in files
    ]


def left(found: list[StoredCheckpoint], **settings: int) -> str:
    """The files of those that stay."""
    stay = staying(found, StoreSettings(**settings))
    return "".join(sorted({name for one in stay for name in one.files}))


def test_the_newest_stay() -> None:
    found = checkpoints("fa", "e", "d", "c")
    assert left(found, keep=2) == "aef"
    assert left(found, keep=3) == "adef"
    assert left(found, keep=9) == "acdef"


def test_bytes_are_counted_once_and_two_stay_in_any_case() -> None:
    found = checkpoints("fa", "ea", "da", "ca", "b")
    assert left(found, keep_bytes=40) == "adef"
    assert left(found, keep_bytes=50) == "acdef"
    assert left(found, keep_bytes=1) == "aef"


def test_what_undoes_resets_stays_beyond_the_newest() -> None:
    found = checkpoints("f", "e", "d!", "c", "b!", "a!")
    assert left(found, keep=2) == "abdef"
    assert left(found, keep=2, keep_resets=2) == "bdef"
    assert left(found, keep=2, keep_resets=0) == "ef"


def test_what_undoes_resets_comes_before_others_where_bytes_are_scarce() -> None:
    found = checkpoints("f", "e", "d", "c!", "b", "a!")
    assert left(found, keep_bytes=40) == "acef"
    assert left(found, keep_bytes=30) == "cef"


def test_what_a_restored_map_went_on_from_stays() -> None:
    found = checkpoints("f", "e", "d", "c!", "b", "a!")
    found[0] = dataclasses.replace(found[0], restored_as="b")
    assert left(found, keep=2) == "abcef"
    assert left(found, keep=2, keep_bytes=40) == "acef"


# In a store


def test_what_is_no_file_does_not_stop_the_retention(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=2))) as store:
        (store.folder / "epoch-000000000.checkpoint").mkdir()
        os.mkfifo(store.folder / "epoch-000000000.triquad")
        (store.folder / "epoch-000000001.checkpoint").symlink_to("nowhere")
        for epoch in range(2, 6):
            store.write(*changes(grown(1, epoch)))
        assert sorted(paths(store)) == [4, 5]


def test_parts_go_with_the_last_checkpoint_that_names_them(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=3))) as store:
        records = drive(store, 5, ROW[:1])
        found = paths(store)
        assert sorted(found) == [4, 5, 6]
        for epoch in (4, 5, 6):
            assert_same(read_map(found[epoch]), records[epoch])
        needed = set().union(*map(parts_of, found.values()))
        assert set(PartFiles(store.folder).folder.iterdir()) == needed


def test_a_checkpoint_that_is_replaced_within_a_tick_of_the_clock_is_read_again(tmp_path):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=2))) as store:
        store.write(*changes(grown(1, 1)))
        path = paths(store)[1]
        before = path.stat()
        write_checkpoint(path, dataclasses.replace(read_checkpoint(path), undoes="a reset"))
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        for epoch in range(2, 5):
            store.write(*changes(grown(1, epoch)))
        assert sorted(paths(store)) == [1, 3, 4]


def test_a_map_that_was_restored_can_be_restored_back(tmp_path, caplog):
    store = Store(tmp_path, "lab", StoreSettings(keep=100))
    records = drive(store, 2)
    store.restore(1)
    restored = store.newest()
    assert_same(read_map(restored.path), dataclasses.replace(records[1], epoch=4))
    assert restored.checkpoint.restored.epoch == 1
    assert parts_of(paths(store)[4]) == parts_of(paths(store)[1])
    store.restore(1)  # as a service does that is started again
    assert "to go back there again, use --restore 4" in caplog.text
    assert sorted(paths(store)) == [1, 2, 3, 4]
    store.restore(3)
    assert_same(read_map(store.newest().path), dataclasses.replace(records[3], epoch=5))
    store.close()


def test_a_map_that_was_restored_can_be_restored_once_more(tmp_path, caplog):
    with closing(Store(tmp_path, "lab", StoreSettings(keep=2))) as store:
        records = drive(store, 1)
        store.restore(1)
        for epoch in range(4, 8):
            store.write(*changes(grown(epoch, epoch)))
        store.restore(1)
        assert "to go back there again, use --restore 3" in caplog.text
        store.restore(3)
        assert_same(read_map(store.newest().path), dataclasses.replace(records[1], epoch=8))
