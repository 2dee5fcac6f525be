import multiprocessing
import os
import random
from contextlib import closing, suppress

from support.files.growing_store import changes
from support.files.store_writer import KEPT, record_at, write_for_ever
from support.maps.map_records import assert_same
from triquad_format.mapfile.checkpoint_folder import PartFiles, checkpoint_files
from triquad_format.mapfile.reader import open_manifest, read_map
from triquad_server.settings import StoreSettings
from triquad_server.store.store import Store

KILLS = int(os.environ.get("TRIQUAD_KILLS", "8"))


def last_sent(received):
    last = None
    with suppress(EOFError):
        while received.poll():
            last = received.recv()
    return last


def test_whenever_the_writer_is_killed_all_that_was_acknowledged_is_there(tmp_path):
    """SIGKILL at random moments of writing, renaming and deleting."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["triquad_server.store.store", "triquad_server.launch"])
    moments = random.Random(5)
    epoch = 0
    for _ in range(KILLS):
        received, sent = processes.Pipe(duplex=False)
        writer = processes.Process(target=write_for_ever, args=(tmp_path, sent))
        writer.start()
        sent.close()
        assert received.poll(60)
        assert received.recv() == epoch, "the store did not go on from its newest checkpoint"
        assert received.poll(60), "it wrote nothing"
        writer.join(moments.uniform(0, 0.1))
        writer.kill()
        writer.join()
        acknowledged = last_sent(received) or epoch
        received.close()
        with closing(Store(tmp_path, "lab", StoreSettings(keep=KEPT))) as store:
            restored = store.newest()
            files = checkpoint_files(store.folder)
        assert restored is not None or acknowledged == 0
        epoch = restored.record.epoch if restored else 0
        assert epoch >= acknowledged
        if restored:
            assert_same(read_map(restored.path), record_at(epoch))
    assert epoch >= KILLS
    older = files[:KEPT]
    assert len(older) == KEPT
    for file in older:
        assert_same(read_map(file.path), record_at(file.epoch))
    assert not list((tmp_path / "lab").glob("*.damaged"))
    parts = PartFiles(tmp_path / "lab")
    with closing(Store(tmp_path, "lab", StoreSettings(keep=KEPT))) as store:
        store.write(*changes(record_at(epoch + 1)))
        files = checkpoint_files(store.folder)
    named = {e.name for file in files for e in open_manifest(file).entries}
    assert parts.names() == named, "parts stay that no checkpoint names, or others are gone"
    assert len(list(parts.folder.iterdir())) == len(named)
