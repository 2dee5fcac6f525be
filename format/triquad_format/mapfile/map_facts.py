"""What a map file says of the whole map; it stands at the file's beginning and in its manifest."""

import dataclasses
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from triquad_format.errors import DamagedMapFileError, UnsupportedMapFileError
from triquad_format.mapfile.parts.part import MANIFEST, MAP
from triquad_format.mapfile.parts.part_body import PartBody
from triquad_format.records.field_settings import FieldSettings
from triquad_format.wire.keys import check_name

FRAME_ID = "map"
UNITS = "m"


@dataclass(frozen=True)
class MapFacts:
    """Name, epoch and settings of a map."""

    name: str
    epoch: int
    settings: FieldSettings


def pack_facts(facts: MapFacts) -> dict[str, object]:
    """The facts as a msgpack map."""
    defaults = dataclasses.asdict(FieldSettings())
    settings = dataclasses.asdict(facts.settings)
    return {
        "name": facts.name,
        "epoch": facts.epoch,
        "frame_id": FRAME_ID,
        "units": UNITS,
        "settings": {name: type(defaults[name])(value) for name, value in settings.items()},
    }


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
    return MapFacts(name, body.count("epoch"), unpack_settings(body.mapping("settings")))


def check_map_part(payload: bytes, facts: MapFacts) -> None:
    """Raise :class:`FormatError` unless the part ``/triquad/map`` tells the same facts."""
    if unpack_facts(PartBody(MAP, payload)) != facts:
        raise DamagedMapFileError(f"{MAP} and {MANIFEST} contradict each other")


def unpack_settings(body: Mapping[str, object]) -> FieldSettings:
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
