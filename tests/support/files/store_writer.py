"""A process that writes checkpoints without end, to be killed."""

import dataclasses
from contextlib import closing
from multiprocessing.connection import Connection
from pathlib import Path

from support.maps.map_records import random_record
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import MapRecord, Region
from triquad_server.mapping.map_snapshot import MapChanges
from triquad_server.mapping.mapper import Mapper
from triquad_server.settings import Settings, StoreSettings
from triquad_server.store.store import Store

ROW: tuple[RegionIndex, ...] = tuple((x, 0, 0) for x in range(6))
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
        asked = Mapper("lab", Settings(field=record_at(0).settings), "cpu").publish()
        acknowledged.send(epoch)
        while True:
            epoch += 1
            base = store.base_epoch
            record = record_at(epoch)
            regions = tuple(
                region
                for i, region in enumerate(record.regions)
                if base is None or changed_last(epoch, i) > base
            )
            store.write(MapChanges(dataclasses.replace(record, regions=regions), ROW, asked))
            acknowledged.send(epoch)
