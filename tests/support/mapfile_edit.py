"""Map files taken apart and put together again, so that tests can change them anywhere."""

import dataclasses
import hashlib
import io
from typing import NamedTuple

import msgpack
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from triquad_format.errors import DamagedMapFileError, MapFileError
from triquad_format.mapfile.index import check_range
from triquad_format.mapfile.manifest import FileRef, pack_manifest, unpack_manifest
from triquad_format.mapfile.metadata import MapFacts
from triquad_format.mapfile.parts.pack import pack_record
from triquad_format.mapfile.parts.part import MANIFEST
from triquad_format.mapfile.reader import read_map
from triquad_format.mapfile.writer import write_map, write_parts
from triquad_format.wire.codec import pack_array, unpack_array
from triquad_map.stored_map import StoredMap
from triquad_server.mesh.preview import previews_of


class MemoryBytes:
    """A map file's bytes in memory, read at random."""

    def __init__(self, data, name="map file"):
        self.name = name
        self.size = len(data)
        self._data = memoryview(data)

    def read(self, offset, length):
        """As :meth:`RandomAccess.read`."""
        check_range(offset, length, self.size)
        return bytes(self._data[offset : offset + length])

    def close(self):
        """Do nothing: there is no file."""


class RawPart(NamedTuple):
    """A message of a map file."""

    topic: str
    payload: bytes


def file_bytes(record, *, preview=False, distances=None, stamp_ns=None, **options):
    """A complete map file."""
    stream = io.BytesIO()
    if preview:
        options["previews"] = previews_of(record, distances=distances, stamp_ns=stamp_ns)
    write_map(record, stream, stamp_ns=stamp_ns, **options)
    return stream.getvalue()


def read_bytes(data):
    return read_map(io.BytesIO(data))


def stored(data):
    """The map of a file's bytes, by random access."""
    return StoredMap(MemoryBytes(data))


def stored_record(data):
    """The record in a file's bytes, part by part."""
    with stored(data) as map_file:
        return map_file.record()


def assert_refused(data):
    """Both ways of reading refuse the file as damaged, with a text."""
    for read, error in ((read_bytes, DamagedMapFileError), (stored_record, MapFileError)):
        with pytest.raises(error) as refusal:
            read(data)
        assert str(refusal.value)


def parts_of(data):
    """The messages of a file by the stock reader, which also checks the CRCs it knows."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    return [
        RawPart(channel.topic, message.data)
        for _, channel, message in reader.iter_messages(log_time_order=False)
    ]


def metadata_of(data):
    return {m.name: m.metadata for m in make_reader(io.BytesIO(data)).iter_metadata()}


def manifest_of(data):
    return unpack_manifest(parts_of(data)[-1].payload, len(data))


def rebuild(parts, metadata, *, encoding="msgpack", chunk_size=1, **options):
    """An MCAP file with right CRCs around whatever parts are given, each in its own chunk."""
    stream = io.BytesIO()
    writer = Writer(stream, enable_data_crcs=True, chunk_size=chunk_size, **options)
    writer.start()
    for name, entries in metadata.items():
        writer.add_metadata(name, entries)
    channels = {}
    for part in parts:
        if part.topic not in channels:
            channels[part.topic] = writer.register_channel(part.topic, encoding, 0)
        writer.add_message(channels[part.topic], 0, part.payload, 0)
    writer.finish()
    return stream.getvalue()


def without_index(data):
    """The map with all parts in one chunk, as other tools write it: it can only be read whole."""
    return rebuild(parts_of(data), metadata_of(data), chunk_size=1 << 30)


def listed(parts, manifest):
    """Parts and a manifest with their sizes and digests; keys are those of ``manifest``."""
    own = tuple(
        dataclasses.replace(
            entry, size=len(part.payload), sha256=hashlib.sha256(part.payload).digest()
        )
        for entry, part in zip(manifest.own, parts, strict=True)
    )
    others = tuple(entry for entry in manifest.entries if entry.file is not None)
    packed = pack_manifest(dataclasses.replace(manifest, entries=own + others))
    return [*parts, RawPart(MANIFEST, packed.payload)]


def with_part(data, at, payload, **options):
    """The file with another payload in one of its parts; digests fit."""
    parts = parts_of(data)
    parts[at] = parts[at]._replace(payload=payload)
    is_manifest = at in (-1, len(parts) - 1)
    whole = parts if is_manifest else listed(parts[:-1], manifest_of(data))
    return rebuild(whole, metadata_of(data), **options)


def edited(data, topic, edit, number=0):
    """The file with the body of the ``number``-th part of a topic edited; digests fit."""
    parts = parts_of(data)
    at = [i for i, part in enumerate(parts) if part.topic == topic][number]
    body = msgpack.unpackb(parts[at].payload)
    edit(body)
    return with_part(data, at, msgpack.packb(body))


def with_manifest(data, edit):
    """The file with another manifest, which ``edit`` makes of its own."""
    parts = parts_of(data)
    parts[-1] = RawPart(MANIFEST, pack_manifest(edit(manifest_of(data))).payload)
    return rebuild(parts, metadata_of(data))


def with_metadata(data, changes):
    """The file with other values in its metadata; ``None`` takes one out."""
    metadata = metadata_of(data)
    metadata["triquad"].update(changes)
    metadata["triquad"] = {k: v for k, v in metadata["triquad"].items() if v is not None}
    return rebuild(parts_of(data), metadata)


def set_field(key, value):
    return lambda body: body.__setitem__(key, value)


def set_array(key, array):
    return set_field(key, pack_array(array))


def shorten(key, axis):
    """Cut the last row off one column of a part."""

    def edit(body):
        planes = unpack_array(key, body[key])
        body[key] = pack_array(np.ascontiguousarray(np.delete(planes, -1, axis)))

    return edit


def all_of(*edits):
    return lambda body: [edit(body) for edit in edits]


def in_level(number, edit):
    """Edit the rows of one level of a part."""
    return lambda body: edit(body["levels"][number])


def write_pair(
    folder,
    base,
    record,
    *,
    names=("base.triquad", "next.triquad"),
    stamps=(None, None),
    preview_schema=None,
):
    """A complete file of ``base``, and one of what ``record`` changes of it."""
    options = {"preview_schema": preview_schema}
    first = write_record(folder / names[0], base, stamp_ns=stamps[0], **options)
    known = first.manifest.elsewhere(FileRef(names[0], first.manifest_sha256))
    later = write_record(folder / names[1], record, stamp_ns=stamps[1], known=known, **options)
    return first, later


def write_record(path, record, **options):
    """A file of all parts of a record; options are those of ``write_parts``."""
    facts = MapFacts.of(record)
    parts = pack_record(record, "<f2", {})
    return write_parts(path, facts, parts, **options)
