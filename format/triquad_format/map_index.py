"""A map file opened by its index: its manifest at once, each part when it is asked for."""

import hashlib
from collections.abc import Callable

from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    NoIndexError,
    UnsupportedMapFileError,
)
from triquad_format.manifest import Entry, FileRef, Manifest, unpack_manifest
from triquad_format.map_facts import FRAME_ID, UNITS, MapFacts, check_map_part
from triquad_format.mapfile_writer import BASE_FILES, FORMAT_VERSION, METADATA_NAME
from triquad_format.mcap_index import McapIndex
from triquad_format.part import MANIFEST, MAP, PartKey
from triquad_format.random_access import RandomAccess

KNOWN_FEATURES: frozenset[str] = frozenset({BASE_FILES})
"""The ``required_features`` that this reader understands."""

OpenFile = Callable[[FileRef], RandomAccess]
"""Opens another file of the same folder."""


class OtherFiles:
    """The other files that hold parts of a map; each is opened when it is needed."""

    def __init__(self, open_file: OpenFile | None) -> None:
        self._open_file = open_file
        self._indices: dict[FileRef, MapIndex] = {}

    def payload(self, entry: Entry) -> bytes:
        """The payload of a part that another file holds.

        Raises:
            MapFileError: that file is missing, damaged or another.
        """
        assert entry.file is not None
        if entry.file not in self._indices:
            self._indices[entry.file] = self._open(entry.file)
        index = self._indices[entry.file]
        try:
            return index.payload(index.find(entry))
        except (MapFileError, OSError) as error:
            raise DamagedMapFileError(f"{entry.file.name}, which holds parts: {error}") from error

    def close(self) -> None:
        """Close them."""
        for index in self._indices.values():
            index.close()

    def _open(self, file: FileRef) -> "MapIndex":
        if self._open_file is None:
            raise MapFileError(f"parts lie in {file.name}, which cannot be reached from here")
        try:
            source = self._open_file(file)
            try:
                return _index_of(file, source)
            except BaseException:
                source.close()
                raise
        except (FormatError, OSError) as error:
            raise DamagedMapFileError(f"{file.name}, which holds parts: {error}") from error


class MapIndex:
    """The manifest of a map file, and its parts by random access.

    What is read is checked: the summary and the manifest by their checksums, each part by its
    digest. What is not read is not.
    """

    def __init__(self, source: RandomAccess, open_file: OpenFile | None = None) -> None:
        """Read metadata and manifest.

        Args:
            source: the file; it is closed with this index.
            open_file: opens the other files that hold parts; needed where there are any.

        Raises:
            MapFileError: it is not a map file, is damaged, or needs a newer reader.
        """
        self._source = source
        self._others = OtherFiles(open_file)
        self._mcap = McapIndex(source)
        self.metadata = one_metadata(self._mcap.metadata(METADATA_NAME))
        if reader_version(self.metadata) < 2:
            raise NoIndexError("a map file of version 1 has no index: triquad-pack rewrites it")
        last = self._mcap.chunks - 1
        message = self._mcap.message(last) if last >= 0 else None
        if message is None or message.topic != MANIFEST:
            raise NoIndexError("its last chunk is not its manifest: triquad-pack rewrites it")
        self.manifest = unpack_manifest(message.data, source.size)
        self.manifest_sha256 = hashlib.sha256(message.data).digest()
        own = self.manifest.own
        if len(own) != last:
            raise DamagedMapFileError(f"{last} parts, but its manifest lists {len(own)}")
        check_agreement(self.metadata, self.manifest.facts)
        check_features(self.metadata, self.manifest)
        self._numbers = {entry.key: number for number, entry in enumerate(own)}
        self._own = {entry.key: entry for entry in own}
        if (stated := self._own.get(PartKey(MAP))) is not None:
            check_map_part(self.payload(stated), self.manifest.facts)

    def close(self) -> None:
        """Close this file and the others that were opened."""
        self._source.close()
        self._others.close()

    def payload(self, entry: Entry) -> bytes:
        """The payload of a part that the manifest lists.

        Raises:
            MapFileError: the part is damaged, or the file that holds it is missing or another.
        """
        if entry.file is not None:
            return self._others.payload(entry)
        number = self._numbers[entry.key]
        message = self._mcap.message(number)
        check_part(number, entry, message.topic, message.data)
        return message.data

    def find(self, entry: Entry) -> Entry:
        """The part of this file that another file's ``entry`` is about."""
        own = self._own.get(entry.key)
        if own is None or own.sha256 != entry.sha256:
            raise DamagedMapFileError(f"it does not hold {entry.key}")
        return own


def _index_of(file: FileRef, source: RandomAccess) -> MapIndex:
    index = MapIndex(source)
    if index.manifest_sha256 != file.manifest_sha256:
        raise DamagedMapFileError("it is not the file that the map was made with")
    return index


def one_metadata(found: list[dict[str, str]]) -> dict[str, str]:
    """The metadata record ``triquad``, of which there must be one."""
    if not found:
        raise MapFileError("this is an MCAP file, but not a map: it has no metadata 'triquad'")
    if len(found) > 1:
        raise DamagedMapFileError("the metadata 'triquad' is there more than once")
    return found[0]


def reader_version(metadata: dict[str, str]) -> int:
    """The version that is needed to read the file.

    Raises:
        UnsupportedMapFileError: it is newer than this reader; the text names what is missing.
        DamagedMapFileError: the metadata does not tell.
    """
    needed = metadata.get("min_reader_version", "")
    # int() alone would also take '+1', ' 1' and digits of other scripts, of any length.
    if not (needed.isascii() and needed.isdigit() and len(needed) < 10):
        raise DamagedMapFileError(f"min_reader_version = {needed!r:.40} is not a number")
    if int(needed) > FORMAT_VERSION:
        raise UnsupportedMapFileError(
            f"it needs a reader of map file version {needed}; this one reads {FORMAT_VERSION}: "
            f"install a newer triquad (written by {metadata.get('producer', 'unknown')!r:.80})",
        )
    if "required_features" not in metadata:
        raise DamagedMapFileError("the metadata 'triquad' does not name its required_features")
    missing = _required(metadata) - KNOWN_FEATURES
    if missing:
        unknown = ", ".join(sorted(missing))
        raise UnsupportedMapFileError(
            f"it requires {unknown:.200}, which this reader does not know: install a newer triquad"
        )
    return int(needed)


def _required(metadata: dict[str, str]) -> set[str]:
    return {name.strip() for name in metadata["required_features"].split(",")} - {""}


def check_part(number: int, entry: Entry, topic: str, data: bytes) -> None:
    """Raise :class:`DamagedMapFileError` unless a part is the one that is listed."""
    fits = topic == entry.key.topic and len(data) == entry.size
    if not fits or hashlib.sha256(data).digest() != entry.sha256:
        raise DamagedMapFileError(
            f"part {number}, {topic:.80}, is not the one that the manifest lists there",
        )


def check_features(metadata: dict[str, str], manifest: Manifest) -> None:
    """Raise :class:`DamagedMapFileError` where a feature is used that is not required."""
    if manifest.files and BASE_FILES not in _required(metadata):
        raise DamagedMapFileError(f"parts lie in other files, but {BASE_FILES} is not required")


def check_agreement(metadata: dict[str, str], facts: MapFacts) -> None:
    """Raise :class:`DamagedMapFileError` unless metadata and parts tell the same."""
    wanted = {
        "map": facts.name,
        "epoch": str(facts.epoch),
        "frame_id": FRAME_ID,
        "units": UNITS,
    }
    for key, value in wanted.items():
        if metadata.get(key) != value:
            raise DamagedMapFileError(
                f"its metadata says {key} = {metadata.get(key)!r:.80}, its parts say {value!r}",
            )
