"""A folder of checkpoints: the epochs of a map that can be read back, and their parts.

A server writes ``epoch-<number>.checkpoint``, which lists parts. A whole map file that is put there
as ``epoch-<number>.triquad``, such as a backup, counts as a checkpoint, too. Each part is kept
once, in a file named by its digest: one zstd frame, whose content is the payload of the part.
"""

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.container import MAX_STORED_BYTES, decompress
from triquad_format.mapfile.files import DAMAGED_SUFFIX, FileBytes, naming, sync_folder
from triquad_format.mapfile.manifest import Entry
from triquad_format.mapfile.parts.pack import check_part, compressed
from triquad_format.mapfile.parts.part import MAX_PART_BYTES, Part

PARTS_NAME = "parts"
"""The folder of the parts, in the folder of the checkpoints."""

_PART_NAME = re.compile("[0-9a-f]{64}")

_NAME = re.compile(r"epoch-([0-9]{9,19})\.(checkpoint|triquad)")

_LISTED = 40  # epochs in the text of an error


@dataclass(frozen=True, order=True)
class CheckpointFile:
    """A checkpoint, by its name."""

    epoch: int
    path: Path


def checkpoint_name(epoch: int) -> str:
    """Return the name of a checkpoint's file."""
    return f"epoch-{epoch:09d}.checkpoint"


def checkpoint_file(path: Path) -> CheckpointFile | None:
    """Return the checkpoint of that name; ``None`` where it is not the name of one."""
    match = _NAME.fullmatch(path.name)
    if match is None or int(match[1]) >= 2**63:
        return None
    return CheckpointFile(int(match[1]), path)


def checkpoint_files(folder: Path) -> list[CheckpointFile]:
    """Return the checkpoints in a folder, newest first.

    What is no file, or a link to none, is left out.

    Raises:
        OSError: the folder cannot be read.
    """
    found = [checkpoint_file(path) for path in folder.iterdir() if path.is_file()]
    return sorted((file for file in found if file is not None), reverse=True)


def set_aside(folder: Path) -> list[Path]:
    """Return checkpoints in a folder that a server found damaged and renamed, in order of names.

    Raises:
        OSError: the folder cannot be read.
    """
    ended = [path for path in folder.iterdir() if path.name.endswith(DAMAGED_SUFFIX)]
    return sorted(path for path in ended if checkpoint_file(path.with_suffix("")) is not None)


def map_folder(store: Path) -> Path:
    """Return the folder of checkpoints that ``store`` is, or the only one that it contains.

    Raises:
        MapFileError: there is none, or there are several; the text names them.
        OSError: the folder cannot be read.
    """
    if checkpoint_files(store):
        return store
    maps = sorted(path for path in store.iterdir() if path.is_dir() and checkpoint_files(path))
    if len(maps) != 1:
        names = ", ".join(path.name for path in maps) or "none"
        raise MapFileError(f"{store} is not a folder of checkpoints; maps in it: {names}")
    return maps[0]


def checkpoint_of(folder: Path, epoch: int) -> CheckpointFile:
    """Return the checkpoint of an epoch.

    Raises:
        MapFileError: there is none; the text says which there are.
        OSError: the folder cannot be read.
    """
    files = checkpoint_files(folder)
    for file in files:
        if file.epoch == epoch:
            return file
    there = ", ".join(str(file.epoch) for file in files[:_LISTED]) or "none"
    more = ", ..." if len(files) > _LISTED else ""
    raise MapFileError(f"{folder} holds no checkpoint of epoch {epoch}; there are: {there}{more}")


class PartFiles:
    """Reads the parts of checkpoints."""

    def __init__(self, folder: Path) -> None:
        """Take the folder of the checkpoints."""
        self.folder = folder / PARTS_NAME

    def names(self) -> set[str]:
        """Return the names of all parts that are there; none where there is no folder."""
        with contextlib.suppress(FileNotFoundError):
            return {name for name in os.listdir(self.folder) if _PART_NAME.fullmatch(name)}
        return set()

    def has(self, entry: Entry) -> bool:
        """Return whether the part is there in its size; its content is not looked at."""
        try:
            return (self.folder / entry.name).stat().st_size == entry.stored
        except OSError:
            return False

    def payload(self, entry: Entry) -> bytes:
        """Return the payload of a part.

        Raises:
            DamagedMapFileError: it is missing, or is damaged.
            OSError: it cannot be read.
        """
        with _named(entry.name), closing(FileBytes(self.folder / entry.name)) as file:
            if file.size != entry.stored:
                raise DamagedMapFileError(f"it has {file.size} bytes, not {entry.stored}")
            return _content(file, entry.name, entry.size)

    def check(self, name: str) -> int:
        """Check the part of this name, and return the bytes of its file.

        Raises:
            DamagedMapFileError: it is missing, or is damaged.
            OSError: it cannot be read.
        """
        with _named(name), closing(FileBytes(self.folder / name)) as file:
            _content(file, name)
            return file.size


class NewParts:
    """Writes parts of one checkpoint: each that is not there yet, and durably with the others."""

    def __init__(self, folder: Path, epoch: int) -> None:
        """Make the folder of parts, in that of the checkpoints, if need be.

        Args:
            folder: that of the checkpoints.
            epoch: in which the parts changed.

        Raises:
            OSError: it cannot be made.
        """
        self._files = PartFiles(folder)
        self._epoch = epoch
        self._unfinished: dict[Path, Path] = {}  # names for good, by temporary ones
        self._files.folder.mkdir(exist_ok=True)

    def add(self, part: Part, known: Entry | None = None) -> Entry:
        """Return the entry of a part, whose file is written unless an intact one is there.

        ``known`` is what the key had in an earlier checkpoint, which is returned where it is equal
        and its file is there in its size.

        Raises:
            FormatError: it is too large to be read.
            OSError: it cannot be written.
        """
        check_part(part)
        digest = hashlib.sha256(part.payload)
        if known is not None and known.sha256 == digest.digest() and self._files.has(known):
            return known
        path = self._files.folder / digest.hexdigest()
        # One that cannot be read is as good as one that is damaged.
        with contextlib.suppress(DamagedMapFileError, OSError):
            return self._entry(part, digest.digest(), stored=self._files.check(path.name))
        frame = compressed(part)
        temporary = path.with_name(f".{path.name}.tmp")
        with naming(path):
            temporary.write_bytes(frame)
        self._unfinished[temporary] = path
        return self._entry(part, digest.digest(), stored=len(frame))

    def copy(self, entry: Entry, folder: Path) -> None:
        """Take a part from another folder of checkpoints, unless it is here.

        Raises:
            DamagedMapFileError: it is missing there, or is damaged.
            OSError: it cannot be read, or written.
        """
        if self._files.has(entry):
            return
        PartFiles(folder).check(entry.name)
        path = self._files.folder / entry.name
        temporary = path.with_name(f".{path.name}.tmp")
        with naming(path):
            temporary.write_bytes((PartFiles(folder).folder / entry.name).read_bytes())
        self._unfinished[temporary] = path

    def commit(self) -> None:
        """Make all parts durable, and give them their names.

        Raises:
            OSError: one cannot be written.
        """
        # All were handed to the system before: it writes them together at the first sync.
        for temporary, path in self._unfinished.items():
            with naming(path), temporary.open("rb") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
        self._unfinished.clear()
        sync_folder(self._files.folder)

    def _entry(self, part: Part, digest: bytes, stored: int) -> Entry:
        return Entry(
            part.key,
            size=len(part.payload),
            sha256=digest,
            epoch=self._epoch,
            stored=stored,
        )


def _content(file: FileBytes, name: str, limit: int = MAX_PART_BYTES) -> bytes:
    """Return the payload in the file of a part, of at most ``limit`` bytes.

    Raises:
        DamagedMapFileError: it is not what the file's name says.
    """
    if file.size > MAX_STORED_BYTES:
        raise DamagedMapFileError(f"it has {file.size} bytes, and no part has as many")
    payload = decompress(file.read(0, file.size), limit)
    if hashlib.sha256(payload).hexdigest() != name:
        raise DamagedMapFileError("its content is not what its name says")
    return payload


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Name the part in what is raised.

    Raises:
        DamagedMapFileError: the part is missing, or damaged.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise DamagedMapFileError(f"{PARTS_NAME}/{name} is missing") from error
    except DamagedMapFileError as error:
        raise DamagedMapFileError(f"{PARTS_NAME}/{name}: {error}") from error
