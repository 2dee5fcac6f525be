"""A process that writes checkpoints without end, to be killed."""

import dataclasses
from contextlib import closing
from multiprocessing.connection import Connection
from pathlib import Path

from support.files.growing_store import ROW, changes
from support.maps.map_records import random_record
from triquad_format.records.region import MapRecord, Region
from triquad_server.settings import StoreSettings
from triquad_server.store.store import Store

KEPT = 6


def changed_last(epoch: int, place: int) -> int:
    """The last epoch up to ``epoch`` in which a region changed: each in turn, the first ever.

    Every seventh epoch changes all.
    """
    whole = epoch - epoch % 7
    turns = [e for e in range(whole + 1, epoch + 1) if place in (0, e % len(ROW))]
    return max([whole, *turns])


def region_at(epoch: int, place: int) -> Region:
    """A region as it is from the epoch ``epoch`` on, in which it changed."""
    record = random_record(epoch, indices=ROW[place : place + 1], points=30)
    return record.regions[0]


def record_at(epoch: int) -> MapRecord:
    """The whole map at an epoch."""
    regions = tuple(region_at(changed_last(epoch, i), i) for i in range(len(ROW)))
    return dataclasses.replace(random_record(0), name="lab", epoch=epoch, regions=regions)


def write_for_ever(root: Path, acknowledged: Connection) -> None:
    """Go on where the store ends; sends the number of each epoch that is durable."""
    with closing(Store(root, "lab", StoreSettings(keep=KEPT))) as store:
        restored = store.newest()
        epoch = restored.record.epoch if restored else 0
        acknowledged.send(epoch)
        while True:
            epoch += 1
            base = store.base_epoch
            only = [r for i, r in enumerate(ROW) if base is None or changed_last(epoch, i) > base]
            store.write(*changes(record_at(epoch), only))
            acknowledged.send(epoch)
