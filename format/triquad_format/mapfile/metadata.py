"""The metadata of a map file: the version that its readers need, and facts of the whole map.

The MCAP metadata record ``triquad`` contains both; the facts stand in the first part and in the
manifest, too.
"""

import dataclasses
import re
import reprlib
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Any

import numpy as np

from triquad_format import __version__
from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.parts.body import PartBody, unpack_body
from triquad_format.mapfile.parts.part import MANIFEST, MAP
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.region import NO_ORIGIN, MapProgress, MapRecord
from triquad_format.wire.keys import check_name
from triquad_format.wire.limits import MAX_POSITION_M
from triquad_format.wire.packing import pack_array

FORMAT_VERSION = 2

FRAME_ID = "map"
UNITS = "m"

PRODUCER = f"triquad {__version__}"

_NUMBER = re.compile("[0-9]{1,18}")  # int() alone would also take '+1', and digits of other scripts

MAX_MAP_BYTES = 4 * 2**30
"""Limit on the size of a map file, and on its parts' decompressed size together."""


def version_of(facts: MapRecord) -> int:
    """Return the oldest version of the format that has all facts of a map."""
    return 1 if facts.origin_m == NO_ORIGIN else 2


def pack_facts(facts: MapRecord) -> dict[str, object]:
    """Return the facts of a map as a msgpack map."""
    defaults = dataclasses.asdict(FieldSettings())
    settings = dataclasses.asdict(facts.settings)
    origin = {} if version_of(facts) == 1 else {"origin": pack_array(np.array(facts.origin_m))}
    return {
        "min_reader_version": version_of(facts),
        "name": facts.name,
        "epoch": facts.epoch,
        "frame_id": FRAME_ID,
        "units": UNITS,
        "settings": {name: type(defaults[name])(value) for name, value in settings.items()},
        "progress": dataclasses.asdict(facts.progress),
        **origin,
    }


def unpack_facts(body: PartBody) -> MapRecord:
    """Return the facts in a part: a map without its regions.

    Raises:
        UnsupportedMapFileError: the part needs a newer reader.
        FormatError: a fact is missing or out of range.
    """
    _check_version(body.count("min_reader_version"), "unknown")
    for key, wanted in (("frame_id", FRAME_ID), ("units", UNITS)):
        if body.value(key, str) != wanted:
            raise UnsupportedMapFileError(f"{key} = {body.value(key, str)!r:.80}, not {wanted!r}")
    name = body.value("name", str)
    check_name("map", name)
    settings = FieldSettings(**_values(FieldSettings(), body.mapping("settings")))
    progress = MapProgress(**_values(MapProgress(), body.mapping("progress")))
    try:
        progress.check()
    except FormatError as error:
        raise DamagedMapFileError(f"{body.topic}: progress: {error}") from error
    return MapRecord(name, body.count("epoch"), settings, (), progress, _origin(body))


def _origin(body: PartBody) -> tuple[float, float, float]:
    """Return the origin of the map in a part; files of version 1 have none."""
    if not body.has("origin"):
        return NO_ORIGIN
    x, y, z = body.array("origin", "<f8", (3,)).tolist()
    if not all(abs(along) <= MAX_POSITION_M for along in (x, y, z)):
        raise DamagedMapFileError(f"{body.topic}: origin = {[x, y, z]} is no place")
    return x, y, z


def check_map_part(payload: bytes, facts: MapRecord) -> None:
    """Raise :class:`FormatError` unless the part ``/triquad/map`` states the same facts."""
    if unpack_facts(unpack_body(MAP, payload)) != facts:
        raise DamagedMapFileError(f"{MAP} and {MANIFEST} contradict each other")


def _values(defaults: FieldSettings | MapProgress, packed: Mapping[str, object]) -> dict[str, Any]:
    """Return the values of settings, or of a progress; all must be there."""
    values: dict[str, Any] = {}
    for name, default in dataclasses.asdict(defaults).items():
        value = packed.get(name)
        if type(default) is float and type(value) is int and abs(value) < 2**53:
            value = float(value)
        if type(value) is not type(default):
            raise DamagedMapFileError(f"{MAP}: {name} = {reprlib.repr(value)}")
        values[name] = value
    return values


def pack_metadata(facts: MapRecord, *, stamp_ns: int, offset: int, stored: int) -> dict[str, str]:
    """Return the metadata of a file, whose manifest is the ``stored`` bytes from ``offset`` on.

    ``stamp_ns`` is the time of its epoch, nanoseconds since 1970; 0: not known.
    """
    entries = {
        "format_version": str(version_of(facts)),
        "min_reader_version": str(version_of(facts)),
        "producer": PRODUCER,
        **_facts_in_metadata(facts),
        "manifest": f"{offset} {stored}",
    }
    if stamp_ns:
        entries["created"] = utc_time(stamp_ns)
    return entries


def utc_time(stamp_ns: int) -> str:
    """Return a time in nanoseconds since 1970 as in RFC 3339, to the second."""
    return datetime.fromtimestamp(stamp_ns // 10**9, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")


def _facts_in_metadata(facts: MapRecord) -> dict[str, str]:
    return {"map": facts.name, "epoch": str(facts.epoch), "frame_id": FRAME_ID, "units": UNITS}


def check_readable(metadata: dict[str, str]) -> None:
    """Refuse a file that this reader does not understand.

    Raises:
        UnsupportedMapFileError: it needs a newer reader; the text names what is missing.
        DamagedMapFileError: the metadata does not say.
    """
    needed = metadata.get("min_reader_version", "")
    if not _NUMBER.fullmatch(needed):
        raise DamagedMapFileError(f"min_reader_version = {needed!r:.40} is not a number")
    _check_version(int(needed), metadata.get("producer", "unknown"))


def _check_version(needed: int, producer: str) -> None:
    if needed > FORMAT_VERSION:
        raise UnsupportedMapFileError(
            f"it needs a reader of map file version {needed}; this one reads {FORMAT_VERSION}: "
            f"install a newer triquad (written by {producer!r:.80})",
        )


def manifest_place(metadata: dict[str, str]) -> tuple[int, int]:
    """Return where the manifest lies: offset and bytes.

    Raises:
        DamagedMapFileError: the metadata does not say.
    """
    offset, _, stored = metadata.get("manifest", "").partition(" ")
    if not (_NUMBER.fullmatch(offset) and _NUMBER.fullmatch(stored)):
        raise DamagedMapFileError(f"manifest = {metadata.get('manifest')!r:.40} is not a place")
    return int(offset), int(stored)


def check_agreement(metadata: dict[str, str], facts: MapRecord) -> None:
    """Raise :class:`DamagedMapFileError` unless metadata and the manifest's facts are the same."""
    for key, value in _facts_in_metadata(facts).items():
        if metadata.get(key) != value:
            raise DamagedMapFileError(
                f"its metadata says {key} = {metadata.get(key)!r:.80}, its parts say {value!r}",
            )
