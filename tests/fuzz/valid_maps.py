"""Small valid map files of every kind, from which mutants are made."""

import dataclasses
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from support import golden
from support.map_records import (
    random_record,
    with_integers,
    with_progress,
    with_rays,
    with_support,
)
from support.mapfile_edit import write_pair
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.map_progress import MapProgress
from triquad_format.records.region import MapRecord
from triquad_map.preview import previews_of
from triquad_map.stored_map import StoredMap

TINY = FieldSettings(
    depth=6, feature_levels=1, feature_size=2, frequencies=1, hidden=2, logit_scale_m=0.5
)
BOX = ([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])

Results = tuple[object, ...]
"""What a reader made of a map."""

Reader = Callable[[Path], Results]


def read_whole(path: Path) -> Results:
    return (read_map(path),)


def read_indexed(path: Path) -> Results:
    with StoredMap.open(path) as stored:
        return (stored.box(*BOX),)


READERS: tuple[Reader, ...] = (read_whole, read_indexed)


@dataclass(frozen=True)
class ValidMap:
    """A map file and those that it needs, in a folder of their own."""

    path: Path  # of the file that is opened
    files: dict[str, bytes]  # of the folder, by their names
    results: tuple[Results, ...]  # of each reader

    def __repr__(self) -> str:
        return self.path.parent.name


def valid_maps(folder: Path) -> list[ValidMap]:
    """Maps of every kind, each written into a folder of its own."""
    plain = with_support(random_record(settings=TINY, points=3, training=False))
    trained = with_rays(with_support(random_record(settings=TINY, points=3)), rays=12)
    complete = {
        "plain": plain,
        "training": with_progress(trained, MapProgress(60, 116_000_000, 0.25)),
        "integers": with_integers(plain),
    }
    maps = [_written(folder / kind, record) for kind, record in complete.items()]
    maps.append(_written_pair(folder / "delta", plain))
    maps.append(_copied(folder / "golden", golden.NEXT, golden.TRAINED))
    return maps


def _written(folder: Path, record: MapRecord) -> ValidMap:
    folder.mkdir()
    previews = previews_of(record) if folder.name == "plain" else None
    write_map(record, folder / "map.triquad", previews=previews)
    return _found(folder / "map.triquad")


def _written_pair(folder: Path, base: MapRecord) -> ValidMap:
    folder.mkdir()
    later = dataclasses.replace(with_integers(base), epoch=base.epoch + 1)
    write_pair(folder, base, later, stamps=(10**9, 2 * 10**9))
    return _found(folder / "next.triquad")


def _copied(folder: Path, *names: str) -> ValidMap:
    folder.mkdir()
    for name in names:
        shutil.copy(golden.FOLDER / name, folder)
    return _found(folder / names[0])


def _found(path: Path) -> ValidMap:
    files = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    return ValidMap(path, files, tuple(read(path) for read in READERS))
