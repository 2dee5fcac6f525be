"""Where settings come from: a preset, over it a TOML file, the environment, the command line."""

import difflib
import json
import os
import reprlib
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic_core import ErrorDetails
from triquad_format.errors import SettingsError

from triquad_server.settings.sections import follows_leaf
from triquad_server.settings.settings import (
    SOURCE_SECTION,
    Settings,
    UnfitSettingsError,
    setting_schemas,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_PREFIX, _DELIMITER = "TRIQUAD_", "__"

_PRESET_FOLDER = Path(__file__).with_name("presets")

PRESETS = ("street", "indoor", "tabletop", "long-range")
"""Settings that fit a kind of place and sensor; each is a file in the folder ``presets``."""


class _Origin(NamedTuple):
    """Settings from one place, as nested tables of values that are not checked yet."""

    name: str
    tables: dict[str, Any]

    def gives(self, location: tuple[int | str, ...]) -> bool:
        """Whether the value at a section and key, or a part of it, comes from here."""
        table: Any = self.tables
        for part in location:
            if not isinstance(table, dict):  # a list comes as a whole
                break
            if part not in table:
                return False
            table = table[part]
        return bool(location)


def load_settings(
    file: Path | None = None, assignments: Iterable[str] = (), *, preset: str | None = None
) -> Settings:
    """The effective settings.

    Args:
        file: a TOML file; what it leaves out is as in the preset, or keeps its default.
        assignments: of the command line, such as ``training.batch=4096``.
        preset: one of :data:`PRESETS`, below all else.

    Raises:
        SettingsError: the file cannot be read, there is no such preset, or a setting is unknown,
            of the wrong type or out of range. The text names the setting, where it comes from
            and what is allowed.
    """
    origins = [
        _Origin(f"preset {preset}", {} if preset is None else _read_preset(preset)),
        _Origin(f"settings file {file}", {} if file is None else _read_file(file)),
        _Origin("environment", _read_environment()),
        _Origin("--set", _parse_assignments(assignments)),
    ]
    merged: dict[str, Any] = {}
    for _, tables in origins:
        merged = _merged(merged, tables)
    try:
        return Settings.model_validate(merged)
    except ValidationError as error:
        texts = [_explain(details, origins) for details in error.errors()]
        raise SettingsError("; ".join(texts)) from error


def settings_toml(settings: Settings) -> str:
    """The settings as a TOML file that :func:`load_settings` reads."""
    tables = settings.model_dump(exclude_none=True)
    # A name in quotes may hold points.
    tables |= {f'sources."{name}"': table for name, table in tables.pop("sources").items()}
    lines: list[str] = []
    for section, table in tables.items():
        lines.append(f"[{section}]")
        for key, value in table.items():
            follows = section in ("scan", "mesh") and follows_leaf(getattr(settings, section), key)
            comment = "  # follows field.leaf_m" if follows else ""
            lines.append(f"{key} = {json.dumps(value)}{comment}")
        lines.append("")
    return "\n".join(lines)


def _merged(tables: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Nested tables, the values of the latter going before those of the former."""
    both = tables | over
    for key in tables.keys() & over.keys():
        if isinstance(tables[key], dict) and isinstance(over[key], dict):
            both[key] = _merged(tables[key], over[key])
    return both


def _read_preset(name: str) -> dict[str, Any]:
    if name not in PRESETS:
        raise SettingsError(f"there is no preset {name!r}: use {', '.join(PRESETS)}")
    return _read_file(_PRESET_FOLDER / f"{name}.toml")


def _read_file(file: Path) -> dict[str, Any]:
    try:
        tables: dict[str, Any] = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"settings file {file}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"settings file {file}: {error}") from error
    return tables


def _read_environment() -> dict[str, Any]:
    tables: dict[str, Any] = {}
    schemas = setting_schemas()
    joined = {f"{section}_{key}": (section, key) for section in schemas for key in schemas[section]}
    for variable in sorted(os.environ):
        names = variable.removeprefix(_PREFIX).lower().split(_DELIMITER)
        is_setting = len(names) > 1 or names[0] in Settings.model_fields
        if variable.startswith(_PREFIX) and is_setting:
            _put(tables, names, os.environ[variable])
        elif variable.startswith(_PREFIX) and names[0] in joined:
            right = _PREFIX + _DELIMITER.join(joined[names[0]]).upper()
            raise SettingsError(f"environment: {variable} is no setting: did you mean {right}?")
    return tables


def _parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        section, *names = name.split(".")
        if section == "sources":  # the name of a source may have points in it
            names = [".".join(names[:-1]), names[-1]] if len(names) > 1 else []
        if not (equals and names):
            form = "sources.NAME" if section == "sources" else "SECTION"
            raise SettingsError(f"--set {assignment}: write {form}.KEY=VALUE")
        _put(tables, [section, *names], text)
    return tables


def _put(tables: dict[str, Any], names: Sequence[str], text: str) -> None:
    """Put what a text stands for into nested tables; a value in place of a table stays."""
    *sections, key = names
    table: Any = tables
    for section in sections:
        table = table.setdefault(section, {})
        if not isinstance(table, dict):
            return
    table[key] = _value(text)


def _value(text: str) -> Any:
    """Return the value that a text would be in a file; without quotes, it may be text itself.

    A number may also be written in ways that a file does not know, such as ``.05``.
    """
    with suppress(ValueError, RecursionError):
        return tomllib.loads(f"value = {text}")["value"]
    with suppress(ValueError):
        return float(text)
    return text


def _explain(details: ErrorDetails, origins: list[_Origin]) -> str:
    """Where a setting comes from, what it is, and what is wrong with it."""
    cause = details.get("ctx", {}).get("error")
    keys = cause.keys if isinstance(cause, UnfitSettingsError) else [details["loc"]]
    givers = [f"{origin.name}: " for origin in origins if any(map(origin.gives, keys))]
    return "".join(givers[-1:]) + _problem(details)  # the last has the last word


def _problem(details: ErrorDetails) -> str:
    location, value = details["loc"], details["input"]
    name = ".".join(map(str, location))
    match details["type"]:
        case "value_error":
            return str(details["ctx"]["error"])
        case "extra_forbidden" | "unexpected_keyword_argument":
            if location[0] == "sources" and isinstance(value, dict):
                return f'{name}: in a file, a name with points stands in quotes, [sources."a.b"]'
            return _unknown(location)
        case "model_type" | "dataclass_type" | "dict_type":
            section = SOURCE_SECTION if name == "sources" else name
            right = f"it is not a section: write [{section}]"
        case "tuple_type" | "missing" | "too_long":
            right = "write two corners, [[x, y, z], [x, y, z]]"
        case _:
            right = details["msg"].replace("Input", "it", 1)
    return f"{name} = {reprlib.repr(value)}: {right}"


def _unknown(location: tuple[int | str, ...]) -> str:
    """That a setting or a section is unknown, with the name that is near to it, if any is."""
    schemas = setting_schemas()
    if len(location) > 2:
        schemas[f"sources.{location[1]}"] = schemas.pop(SOURCE_SECTION)
    names = [f"{section}.{key}" for section, table in schemas.items() for key in table]
    if len(location) < 2:
        names += [section.partition(".")[0] for section in schemas]
    name = ".".join(map(str, location))
    nearest = difflib.get_close_matches(name.lower(), names, n=1)
    remedy = f"did you mean {nearest[0]}?" if nearest else "triquad-server --print-settings has all"
    return f"unknown setting {name}: {remedy}"
