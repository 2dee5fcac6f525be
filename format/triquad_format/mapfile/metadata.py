"""What a map file says of itself: the version that its readers need, and facts of the whole map.

The MCAP metadata record ``triquad`` holds both; the facts stand in the first part and in the
manifest, too.
"""

import dataclasses
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

from triquad_format import __version__
from triquad_format.errors import (
    DamagedMapFileError,
    FormatError,
    MapFileError,
    UnsupportedMapFileError,
)
from triquad_format.mapfile.parts.body import PartBody, unpack_body
from triquad_format.mapfile.parts.part import MANIFEST, MAP
from triquad_format.records.field_settings import FieldSettings
from triquad_format.records.map_progress import MapProgress
from triquad_format.records.region import MapRecord
from triquad_format.wire.keys import check_name

METADATA_NAME = "triquad"
FORMAT_VERSION = 1
MIN_READER_VERSION = 1

BASE_FILES = "base-files"
"""The required feature of a file whose parts lie in other files, too."""

FRAME_ID = "map"
UNITS = "m"

MAX_MAP_BYTES = 4 * 2**30
"""Limit on the size of a map file, and on its chunks' decompressed size together."""


@dataclass(frozen=True)
class MapFacts:
    """Name, epoch, settings and progress of a map."""

    name: str
    epoch: int
    settings: FieldSettings
    progress: MapProgress = MapProgress()

    @classmethod
    def of(cls, record: MapRecord) -> "MapFacts":
        """The facts of a record."""
        return cls(record.name, record.epoch, record.settings, record.progress)


def pack_facts(facts: MapFacts) -> dict[str, object]:
    """The facts as a msgpack map."""
    defaults = dataclasses.asdict(FieldSettings())
    settings = dataclasses.asdict(facts.settings)
    body: dict[str, object] = {
        "name": facts.name,
        "epoch": facts.epoch,
        "frame_id": FRAME_ID,
        "units": UNITS,
        "settings": {name: type(defaults[name])(value) for name, value in settings.items()},
    }
    if facts.progress != MapProgress():
        body["progress"] = dataclasses.asdict(facts.progress)
    return body


def unpack_facts(body: PartBody) -> MapFacts:
    """The facts in a part.

    Raises:
        FormatError: one is missing or out of range.
    """
    for key, wanted in (("frame_id", FRAME_ID), ("units", UNITS)):
        if body.value(key, str) != wanted:
            raise UnsupportedMapFileError(f"{key} = {body.value(key, str)!r:.80}, not {wanted!r}")
    name = body.value("name", str)
    check_name("map", name)
    settings = _unpack_settings(body.mapping("settings"))
    return MapFacts(name, body.count("epoch"), settings, _unpack_progress(body))


def check_map_part(payload: bytes, facts: MapFacts) -> None:
    """Raise :class:`FormatError` unless the part ``/triquad/map`` tells the same facts."""
    if unpack_facts(unpack_body(MAP, payload)) != facts:
        raise DamagedMapFileError(f"{MAP} and {MANIFEST} contradict each other")


def _unpack_progress(body: PartBody) -> MapProgress:
    """The progress of a map; older files do not tell it."""
    if not body.has("progress"):
        return MapProgress()
    told = PartBody(body.topic, body.mapping("progress"))
    progress = MapProgress(
        scans_taken=told.count("scans_taken"),
        samples_trained=told.count("samples_trained"),
        loss=told.value("loss", float),
    )
    try:
        progress.check()
    except FormatError as error:
        raise DamagedMapFileError(f"{body.topic}: progress: {error}") from error
    return progress


def _unpack_settings(body: Mapping[str, object]) -> FieldSettings:
    """The settings of a field; all must be there."""
    values: dict[str, Any] = {}
    for name, default in dataclasses.asdict(FieldSettings()).items():
        value = body.get(name)
        if type(default) is float and type(value) is int and abs(value) < 2**53:
            value = float(value)
        if type(value) is not type(default):
            raise DamagedMapFileError(f"{MAP}: setting {name} = {reprlib.repr(value)}")
        values[name] = value
    return FieldSettings(**values)


def pack_metadata(
    facts: MapFacts, *, stamp_ns: int | None, needs_other_files: bool
) -> dict[str, str]:
    """The metadata of a file, parts of which may lie in other files.

    ``stamp_ns`` is the time of its epoch, nanoseconds since 1970; ``None``: not known.
    """
    entries = {
        "format_version": str(FORMAT_VERSION),
        "min_reader_version": str(MIN_READER_VERSION),
        "required_features": BASE_FILES if needs_other_files else "",
        "producer": f"triquad {__version__}",
        **_facts_in_metadata(facts),
    }
    if stamp_ns is not None:
        entries["created"] = utc_time(stamp_ns)
    return entries


def utc_time(stamp_ns: int) -> str:
    """A time in nanoseconds since 1970 as in RFC 3339, to the second."""
    return datetime.fromtimestamp(stamp_ns // 10**9, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")


def _facts_in_metadata(facts: MapFacts) -> dict[str, str]:
    return {"map": facts.name, "epoch": str(facts.epoch), "frame_id": FRAME_ID, "units": UNITS}


def readable_metadata(found: list[dict[str, str]]) -> dict[str, str]:
    """The metadata of a file that this reader can read.

    Args:
        found: the entries of all metadata records ``triquad``; there must be one.

    Raises:
        MapFileError: there is none: it is no map file.
        UnsupportedMapFileError: it needs a newer reader; the text names what is missing.
        DamagedMapFileError: there are several, or it does not tell which reader it needs.
    """
    if not found:
        raise MapFileError("this is an MCAP file, but not a map: it has no metadata 'triquad'")
    if len(found) > 1:
        raise DamagedMapFileError("the metadata 'triquad' is there more than once")
    check_readable(found[0])
    return found[0]


def check_readable(metadata: dict[str, str]) -> None:
    """Refuse a file that this reader does not understand.

    Raises:
        UnsupportedMapFileError: it needs a newer reader; the text names what is missing.
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
    missing = _required(metadata) - {BASE_FILES}
    if missing:
        unknown = ", ".join(sorted(missing))
        raise UnsupportedMapFileError(
            f"it requires {unknown:.200}, which this reader does not know: install a newer triquad"
        )


def _required(metadata: dict[str, str]) -> set[str]:
    return {name.strip() for name in metadata["required_features"].split(",")} - {""}


def check_agreement(metadata: dict[str, str], facts: MapFacts, *, needs_other_files: bool) -> None:
    """Raise :class:`DamagedMapFileError` unless metadata and manifest tell the same.

    ``facts`` and ``needs_other_files`` are the manifest's: whether it lists parts of other files.
    """
    for key, value in _facts_in_metadata(facts).items():
        if metadata.get(key) != value:
            raise DamagedMapFileError(
                f"its metadata says {key} = {metadata.get(key)!r:.80}, its parts say {value!r}",
            )
    if needs_other_files and BASE_FILES not in _required(metadata):
        raise DamagedMapFileError(f"parts lie in other files, but {BASE_FILES} is not required")
