"""Small valid map files of every kind, from which mutants are made."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from support.files import golden
from support.files.checkpoint_folder import write_record
from support.maps.map_records import random_record, with_integers, with_rays, with_support
from triquad_format.mapfile.reader import StoredMap, read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import MapProgress, MapRecord
from triquad_map.preview import previews_of

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
    """A map file, or a checkpoint with its parts, in a folder of its own."""

    path: Path  # of the file that is opened
    files: dict[str, bytes]  # of the folder, by their paths in it
    results: tuple[Results, ...]  # of each reader

    def __repr__(self) -> str:
        return self.path.parent.name


def valid_maps(folder: Path) -> list[ValidMap]:
    """Maps of every kind, each written into a folder of its own."""
    plain = with_support(random_record(settings=TINY, points=3, training=False))
    trained = with_rays(with_support(random_record(settings=TINY, points=3)), rays=12)
    complete = {
        "plain": plain,
        "training": replace(trained, progress=MapProgress(60, 116_000_000, 0.25)),
        "integers": with_integers(plain),
    }
    maps = [_written(folder / kind, record) for kind, record in complete.items()]
    maps.append(_stored(folder / "store", with_integers(plain)))
    maps.append(_copied(folder / "golden", golden.TRAINED))
    return maps


def _written(folder: Path, record: MapRecord) -> ValidMap:
    folder.mkdir()
    previews = previews_of(record) if folder.name == "plain" else None
    write_map(record, folder / "map.triquad", previews=previews)
    return _found(folder / "map.triquad")


def _stored(folder: Path, record: MapRecord) -> ValidMap:
    folder.mkdir()
    return _found(write_record(folder, record, stamp_ns=10**9))


def _copied(folder: Path, name: str) -> ValidMap:
    folder.mkdir()
    return _found(Path(shutil.copy(golden.FOLDER / name, folder)))


def _found(path: Path) -> ValidMap:
    folder = path.parent
    found = (file for file in folder.rglob("*") if file.is_file())
    files = {str(file.relative_to(folder)): file.read_bytes() for file in found}
    return ValidMap(path, files, tuple(read(path) for read in READERS))
