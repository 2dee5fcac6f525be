"""Checkpoints that must stay for a while: what the map was before a reset, or was restored to.

They are listed in the file ``protected.json`` next to the checkpoints, so that they outlive the
server that listed them.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from triquad_format.errors import MapFileError
from triquad_format.mapfile.durable_file import replacing
from triquad_format.mapfile.index import open_regular

PROTECTIONS_NAME = "protected.json"

_VERSION = 1
_MAX_BYTES = 2**20
_MAX_NUMBER = 2**63


@dataclass(frozen=True)
class Protection:
    """A checkpoint that retention must keep."""

    epoch: int
    age_s: float  # for how long it had been protected at the time of the list
    why: str


@dataclass(frozen=True)
class Restored:
    """A checkpoint that the map was restored to."""

    epoch: int
    as_epoch: int  # under which the map went on


@dataclass(frozen=True)
class Protections:
    """The list of a folder."""

    listed_ns: int = 0  # when it was made, nanoseconds since 1970, by that machine's clock
    checkpoints: tuple[Protection, ...] = ()
    restored: Restored | None = None  # the last time that the map was restored


def read_protections(folder: Path) -> Protections:
    """Return the list of a folder of checkpoints; an empty one where there is none.

    Raises:
        MapFileError: it is damaged, or of a later version.
        OSError: it cannot be read.
    """
    path = folder / PROTECTIONS_NAME
    try:
        with open_regular(path) as file:
            data = file.read(_MAX_BYTES + 1)
    except FileNotFoundError:
        return Protections()
    try:
        if len(data) > _MAX_BYTES:
            raise ValueError(f"it has more than {_MAX_BYTES} bytes")
        return _unpacked(json.loads(data))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise MapFileError(
            f"{path} does not tell which checkpoints are protected ({error!r:.200})"
        ) from error


def write_protections(folder: Path, listed: Protections) -> None:
    """Replace the list of a folder, all of it or nothing.

    Raises:
        OSError: it cannot be written.
    """
    body: dict[str, Any] = {
        "version": _VERSION,
        "listed_ns": listed.listed_ns,
        "checkpoints": [
            {"epoch": one.epoch, "age_s": round(one.age_s, 3), "why": one.why}
            for one in listed.checkpoints
        ],
    }
    if listed.restored is not None:
        body["restored"] = {
            "epoch": listed.restored.epoch,
            "as_epoch": listed.restored.as_epoch,
        }
    with replacing(folder / PROTECTIONS_NAME) as file:
        file.write(json.dumps(body, indent=1).encode() + b"\n")


def _unpacked(body: Mapping[str, Any]) -> Protections:
    if body["version"] != _VERSION:
        raise ValueError(f"version {body['version']!r:.40}; this release reads {_VERSION}")
    restored = None
    if (last := body.get("restored")) is not None:
        restored = Restored(_count(last["epoch"]), _count(last["as_epoch"]))
    checkpoints = tuple(_protection(one) for one in body["checkpoints"])
    return Protections(_count(body["listed_ns"]), checkpoints, restored)


def _protection(body: Mapping[str, Any]) -> Protection:
    age_s, why = float(body["age_s"]), body["why"]
    if not 0 <= age_s < _MAX_NUMBER or not isinstance(why, str):
        raise ValueError(f"age_s = {age_s!r}, why = {why!r:.40}")
    return Protection(_count(body["epoch"]), age_s, why)


def _count(number: object) -> int:
    if type(number) is not int or not 0 <= number < _MAX_NUMBER:
        raise ValueError(f"{number!r:.40} is not a count")
    return number
