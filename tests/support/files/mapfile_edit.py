"""Map files taken apart and put together again, so that tests can change them anywhere."""

import dataclasses
import hashlib
import io
import struct
import tempfile
import zlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgpack
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer
from numpy.typing import NDArray
from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.files import check_range, named
from triquad_format.mapfile.index import MapIndex
from triquad_format.mapfile.manifest import Manifest, pack_manifest
from triquad_format.mapfile.parts.part import MANIFEST
from triquad_format.mapfile.reader import StoredMap, assemble, read_map
from triquad_format.mapfile.writer import write_map
from triquad_format.records.region import MapRecord
from triquad_format.wire.packing import pack_array, unpack_array
from triquad_map.preview import previews_of

Edit = Callable[[dict[str, Any]], object]
"""Changes the msgpack map of a part."""


class RawPart(NamedTuple):
    """A message of a map file, unpacked."""

    topic: str
    payload: bytes


def file_bytes(
    record: MapRecord,
    *,
    preview: bool = False,
    view: Any = None,
    stamp_ns: int = 0,
    **options: Any,
) -> bytes:
    """A complete map file."""
    stream = io.BytesIO()
    if preview:
        options["previews"] = previews_of(record, view, stamp_ns)
    write_map(record, stream, stamp_ns=stamp_ns, **options)
    return stream.getvalue()


class MemoryBytes:
    """The bytes of a file that is in memory: a RandomAccess."""

    def __init__(self, data: bytes) -> None:
        self.name = "map file"
        self.size = len(data)
        self._data = data

    def read(self, offset: int, length: int) -> bytes:
        check_range(offset, length, self.size)
        return self._data[offset : offset + length]

    def close(self) -> None:
        pass


def read_bytes(data: bytes) -> MapRecord:
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        return read_map(file.name)


def stored(data: bytes) -> StoredMap:
    """The map of a file's bytes, by random access."""
    return StoredMap(MemoryBytes(data))


def stored_record(data: bytes) -> MapRecord:
    """The record in a file's bytes, part by part."""
    with stored(data) as map_file, named(map_file.name):
        return assemble(map_file.manifest, map_file.payload)


def assert_refused(data: bytes, text: str | None = None) -> None:
    """Both ways of reading refuse the file as damaged, in words that match ``text``."""
    for read, error in ((read_bytes, DamagedMapFileError), (stored_record, MapFileError)):
        with pytest.raises(error, match=text) as refusal:
            read(data)
        assert str(refusal.value)


def parts_of(data: bytes) -> list[RawPart]:
    """The messages of a file by the stock reader, which also checks the CRCs of chunks."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    return [
        RawPart(
            c.topic, zstandard.decompress(m.data) if c.message_encoding != "protobuf" else m.data
        )
        for _, c, m in reader.iter_messages(log_time_order=False)
    ]


def metadata_of(data: bytes) -> dict[str, str]:
    (record,) = make_reader(io.BytesIO(data)).iter_metadata()
    return record.metadata


def manifest_of(data: bytes) -> Manifest:
    return MapIndex(MemoryBytes(data)).manifest


def rewritten(
    data: bytes,
    *,
    payloads: Mapping[int, bytes] = {},  # noqa: B006
    manifest: Callable[[Manifest], Manifest] = lambda manifest: manifest,
    manifest_payload: Callable[[bytes], bytes] = bytes,
    metadata: Mapping[str, str | None] = {},  # noqa: B006
    fitting: bool = True,
) -> bytes:
    """A valid file with changes; all checksums, places and lengths around them fit.

    Args:
        data: the file.
        payloads: other payloads of its own parts, by their number.
        manifest: changes the manifest.
        manifest_payload: changes the payload of the manifest.
        metadata: other values in the metadata; ``None`` takes one out.
        fitting: whether sizes and digests of other payloads are listed, or those of the file.
    """
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=0, enable_data_crcs=True)
    writer.start()
    channels: dict[str, int] = {}

    def put(topic: str, payload: bytes) -> tuple[int, int]:
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "", 0)
        if topic.startswith("/triquad/"):
            payload = zstandard.compress(payload)
        start = stream.tell()
        writer.add_message(channels[topic], 0, payload, 0)
        return start, stream.tell() - start

    whole = manifest_of(data)
    entries = []
    for number, (entry, part) in enumerate(zip(whole.entries, parts_of(data)[:-1], strict=True)):
        payload = payloads.get(number, part.payload)
        offset, size = put(part.topic, payload)
        entry = dataclasses.replace(entry, offset=offset, stored=size)
        if fitting:
            digest = hashlib.sha256(payload).digest()
            entry = dataclasses.replace(entry, size=len(payload), sha256=digest)
        entries.append(entry)
    whole = manifest(dataclasses.replace(whole, entries=tuple(entries)))
    place = "{} {}".format(*put(MANIFEST, manifest_payload(pack_manifest(whole).payload)))
    told = {**metadata_of(data), "manifest": place, **metadata}
    writer.add_metadata("triquad", {k: v for k, v in told.items() if v is not None})
    writer.finish()
    return stream.getvalue()


def with_fitting_crcs(data: bytes) -> bytes:
    """The bytes, with the checksums of data and summary as they must be, if there is a footer."""
    out = bytearray(data)
    if len(out) < 50:
        return data
    (start,) = struct.unpack_from("<Q", out, len(out) - 28)
    if 13 <= start <= len(out) - 37:
        out[start - 4 : start] = struct.pack("<I", zlib.crc32(out[: start - 13]))
        out[-12:-8] = struct.pack("<I", zlib.crc32(out[start:-12]))
    return bytes(out)


def edited(data: bytes, topic: str, edit: Edit, number: int = 0) -> bytes:
    """The file with the body of the ``number``-th part of a topic edited; digests fit."""

    def change(payload: bytes) -> bytes:
        body = msgpack.unpackb(payload)
        edit(body)
        packed: bytes = msgpack.packb(body)
        return packed

    if topic == MANIFEST:
        return rewritten(data, manifest_payload=change)
    parts = parts_of(data)
    at = [i for i, part in enumerate(parts) if part.topic == topic][number]
    return rewritten(data, payloads={at: change(parts[at].payload)})


def set_field(key: str, value: object) -> Edit:
    return lambda body: body.__setitem__(key, value)


def set_array(key: str, array: NDArray[Any]) -> Edit:
    return set_field(key, pack_array(array))


def shorten(key: str, axis: int) -> Edit:
    """Cut the last row off one column of a part."""

    def edit(body: dict[str, Any]) -> None:
        planes = unpack_array(key, body[key])
        body[key] = pack_array(np.ascontiguousarray(np.delete(planes, -1, axis)))

    return edit


def all_of(*edits: Edit) -> Edit:
    return lambda body: [edit(body) for edit in edits]


def first_level(edit: Edit) -> Edit:
    """Edit the rows of the first level of a part."""
    return lambda body: edit(body["levels"][0])
