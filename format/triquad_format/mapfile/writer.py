"""Writing map files: the same record gives the same bytes, and a path gets all of them or none."""

import contextlib
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from mcap.writer import Writer

from triquad_format.errors import FormatError
from triquad_format.mapfile.container import METADATA_NAME
from triquad_format.mapfile.files import replacing
from triquad_format.mapfile.manifest import Entry, Manifest, pack_manifest
from triquad_format.mapfile.metadata import pack_facts, pack_metadata
from triquad_format.mapfile.parts.pack import check_part, compressed, pack_part, pack_record
from triquad_format.mapfile.parts.part import (
    MAP,
    MESSAGE_ENCODING,
    PREVIEW,
    PREVIEW_ENCODING,
    PREVIEW_SCHEMA,
    Part,
    PartKey,
)
from triquad_format.mapfile.record_check import check_record
from triquad_format.records.field_settings import RegionIndex
from triquad_format.records.region import FLOATS, MapRecord


@dataclass(frozen=True)
class Previews:
    """The previews that MCAP viewers show of a map. Map files carry them as they are given."""

    schema: bytes  # of foxglove.SceneUpdate, a FileDescriptorSet
    parts: Mapping[RegionIndex, Part]  # of the topic PREVIEW


@dataclass(frozen=True)
class MapFileInfo:
    """Size, digest and epoch of a map file that was written."""

    bytes: int  # size of the file
    sha256: str  # of the whole file, hexadecimal
    epoch: int


def write_map(
    record: MapRecord,
    file: BinaryIO | Path | str,
    *,
    feature_dtype: str = "<f2",
    stamp_ns: int = 0,
    previews: Previews | None = None,
) -> MapFileInfo:
    """Write a map file.

    A path is written under a temporary name (``.<name>.<random>.tmp``) in the same folder, synced
    and renamed, so that the final name never has half a file.

    Args:
        record: the map; it is checked first.
        file: a path, or a binary stream at the place where the file begins.
        feature_dtype: ``"<f2"`` or ``"<f4"``, the precision of features that are not int8.
        stamp_ns: time of creation, nanoseconds since 1970; 0: the file has no time.
        previews: what MCAP viewers are to show; left out, the file has nothing of the kind.

    Raises:
        FormatError: the record is not valid, or exceeds a limit of the format.
        OSError: the file cannot be written.
    """
    if feature_dtype not in FLOATS:
        raise FormatError(f"feature_dtype = {feature_dtype!r} is not one of {FLOATS}")
    if not 0 <= stamp_ns < 2**63:
        raise FormatError(f"stamp_ns = {stamp_ns} is out of range: use 0 to 2**63 - 1")
    check_record(record)
    parts = pack_record(record, feature_dtype, {} if previews is None else previews.parts)
    schema = None if previews is None else previews.schema
    return write_parts(file, record.facts, parts, stamp_ns=stamp_ns, preview_schema=schema)


def write_parts(
    file: BinaryIO | Path | str,
    facts: MapRecord,
    parts: Iterable[Part],
    *,
    stamp_ns: int = 0,
    preview_schema: bytes | None = None,
) -> MapFileInfo:
    """Write a map file from parts.

    Args:
        file: as in :func:`write_map`.
        facts: what the file says of the whole map, of which regions are not used.
        parts: what the map consists of.
        stamp_ns: time of its epoch, nanoseconds since 1970; 0: the file has no time.
        preview_schema: that of :class:`Previews`; needed where there are previews among ``parts``.

    Raises:
        FormatError: a limit of the format is exceeded, or there are previews without their schema.
        OSError: the file cannot be written.
    """
    opened = (
        replacing(Path(file)) if isinstance(file, (str, Path)) else contextlib.nullcontext(file)
    )
    with opened as stream:
        return _PartsWriter(stream, facts, stamp_ns, preview_schema).write(parts)


class _Counted:
    """Counts and digests what is written to a stream, which need not be able to seek."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.digest = hashlib.sha256()
        self.size = 0

    def write(self, data: bytes) -> int:
        self.digest.update(data)
        self.size += len(data)
        return self._stream.write(data)

    def tell(self) -> int:
        return self.size


class _PartsWriter:
    """Writes the parts of one file, and keeps what its manifest is to list."""

    def __init__(
        self,
        stream: BinaryIO,
        facts: MapRecord,
        stamp_ns: int,
        preview_schema: bytes | None,
    ) -> None:
        self._stream = _Counted(stream)
        # A chunk ends after each message. The library compresses chunks, which matters to previews
        # alone: parts are compressed before, each as suits it.
        self._mcap = Writer(cast(BinaryIO, self._stream), chunk_size=0, enable_data_crcs=True)
        self._facts = facts
        self._stamp_ns = stamp_ns
        self._preview_schema = preview_schema
        self._channels: dict[str, int] = {}

    def write(self, parts: Iterable[Part]) -> MapFileInfo:
        """Write the file."""
        self._mcap.start(library="triquad")
        entries = [self._stored(pack_part(PartKey(MAP), pack_facts(self._facts)))]
        entries.extend(self._stored(part) for part in parts)
        manifest = Manifest(self._facts, self._stamp_ns, tuple(entries))
        offset, stored = self._put(pack_manifest(manifest))
        metadata = pack_metadata(self._facts, stamp_ns=self._stamp_ns, offset=offset, stored=stored)
        self._mcap.add_metadata(METADATA_NAME, metadata)
        self._mcap.finish()  # type: ignore[no-untyped-call]
        size = self._stream.size
        manifest.check_total(size)
        return MapFileInfo(size, self._stream.digest.hexdigest(), self._facts.epoch)

    def _stored(self, part: Part) -> Entry:
        """Write a part; return its entry."""
        offset, stored = self._put(part)
        return Entry(
            part.key,
            size=len(part.payload),
            sha256=hashlib.sha256(part.payload).digest(),
            epoch=self._facts.epoch,
            offset=offset,
            stored=stored,
        )

    def _put(self, part: Part) -> tuple[int, int]:
        """Write a part; return where its chunk begins, and bytes up to the next."""
        topic = part.key.topic
        check_part(part)
        data = part.payload
        if topic != PREVIEW:
            data = compressed(part)
        start = self._stream.size
        self._mcap.add_message(self._channel(topic), self._stamp_ns, data, self._stamp_ns)
        return start, self._stream.size - start

    def _channel(self, topic: str) -> int:
        """Return the number of a topic's channel, which is described before its first message."""
        if topic not in self._channels:
            schema, encoding = 0, MESSAGE_ENCODING
            if topic == PREVIEW:
                if self._preview_schema is None:
                    raise FormatError(f"there are parts {topic}: give preview_schema as well")
                schema = self._mcap.register_schema(
                    PREVIEW_SCHEMA, PREVIEW_ENCODING, self._preview_schema
                )
                encoding = PREVIEW_ENCODING
            self._channels[topic] = self._mcap.register_channel(topic, encoding, schema)
        return self._channels[topic]
