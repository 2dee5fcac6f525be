"""Where settings come from: a TOML file, over it the environment, over that the command line."""

import difflib
import json
import os
import reprlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)
from triquad_format.errors import SettingsError

from triquad_server.settings import Settings, setting_schemas

_PREFIX, _DELIMITER = "TRIQUAD_", "__"

_NUMBERS = {"integer": TypeAdapter[float](int), "number": TypeAdapter(float)}
"""What reads text as a number, by the type in a setting's schema."""


class _Sources(Settings, BaseSettings):
    """Settings with the names that they have in the environment."""

    model_config = SettingsConfigDict(
        env_prefix=_PREFIX, env_nested_delimiter=_DELIMITER, enable_decoding=False
    )


class _Source(NamedTuple):
    """Settings from one place, as nested tables of values that are not checked yet."""

    origin: str
    tables: dict[str, Any]

    def gives(self, location: tuple[int | str, ...]) -> bool:
        """Whether the value at a section and key comes from here."""
        section = self.tables.get(str(location[0])) if location else None
        if len(location) < 2:
            return section is not None
        return isinstance(section, dict) and location[1] in section


def load_settings(file: Path | None = None, assignments: Iterable[str] = ()) -> Settings:
    """The effective settings.

    Args:
        file: a TOML file; what it leaves out keeps its default.
        assignments: of the command line, such as ``training.batch=4096``.

    Raises:
        SettingsError: the file cannot be read, or a setting is unknown, of the wrong type or out
            of range. The text names the setting, where it comes from and what is allowed.
    """
    sources = [
        _Source(f"settings file {file}", {} if file is None else _read_file(file)),
        _Source("environment", _with_numbers(_read_environment())),
        _Source("--set", _with_numbers(_parse_assignments(assignments))),
    ]
    merged: dict[str, Any] = {}
    for _, tables in sources:
        for section, table in tables.items():
            known = merged.get(section)
            merges = isinstance(known, dict) and isinstance(table, dict)
            merged[section] = known | table if merges else table
    try:
        return Settings.model_validate(merged)
    except ValidationError as error:
        texts = [_explain(details, sources) for details in error.errors()]
        raise SettingsError("; ".join(texts)) from error


def settings_toml(settings: Settings) -> str:
    """The settings as a TOML file that :func:`load_settings` reads."""
    lines: list[str] = []
    for section, table in settings.model_dump().items():
        lines += [f"[{section}]", *(f"{key} = {json.dumps(table[key])}" for key in table), ""]
    return "\n".join(lines)


def _read_file(file: Path) -> dict[str, Any]:
    try:
        file.stat()  # a file that is missing would count as empty
        return TomlConfigSettingsSource(_Sources, file)()
    except (OSError, ValueError, RecursionError) as error:
        raise SettingsError(f"settings file {file}: {error}") from error


def _read_environment() -> dict[str, Any]:
    for variable in os.environ:
        section, delimiter, key = variable.removeprefix(_PREFIX).lower().partition(_DELIMITER)
        if variable.startswith(_PREFIX) and delimiter and section not in Settings.model_fields:
            raise SettingsError(f"environment: {variable}: {_unknown((section, key))}")
    return EnvSettingsSource(_Sources)()


def _parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    tables: dict[str, dict[str, str]] = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        section, dot, key = name.partition(".")
        if not (equals and dot):
            raise SettingsError(f"--set {assignment}: write SECTION.KEY=VALUE")
        tables.setdefault(section, {})[key] = value
    return tables


def _with_numbers(tables: dict[str, Any]) -> dict[str, Any]:
    """Tables of texts as a file would have them: those of numbers are read, where they can be."""
    schemas = setting_schemas()

    def read(section: str, key: str, text: str) -> float | str:
        numbers = _NUMBERS.get(schemas.get(section, {}).get(key, {}).get("type", "string"))
        try:
            return numbers.validate_python(text) if numbers else text
        except ValidationError:
            return text

    return {
        section: {key: read(section, key, text) for key, text in table.items()}
        if isinstance(table, dict)
        else table
        for section, table in tables.items()
    }


def _explain(details: ErrorDetails, sources: list[_Source]) -> str:
    """What is wrong with a setting, and what is right."""
    location = details["loc"]
    origins = [source.origin for source in sources if source.gives(location)]
    # The last source has the last word.
    prefix = f"{origins[-1]}: " if origins else ""
    return prefix + _problem(details, ".".join(map(str, location)))


def _problem(details: ErrorDetails, name: str) -> str:
    location, value = details["loc"], reprlib.repr(details["input"])
    match details["type"]:
        case "value_error":
            return str(details["ctx"]["error"])
        case "extra_forbidden" | "unexpected_keyword_argument":
            return _unknown(location)
        case "model_type" | "dataclass_type":
            return f"{name} = {value} is not a section: write [{name}]"
        case "greater_than_equal" | "less_than_equal":
            return f"{name} = {value} is out of range: use {_allowed(location)}"
        case "int_type" | "float_type":
            quotes = ", without quotes" if isinstance(details["input"], str) else ""
            return f"{name} = {value} is of another type: use {_allowed(location)}{quotes}"
        case _:
            return f"{name} = {value}: {details['msg']}"


def _allowed(location: tuple[int | str, ...]) -> str:
    """The type and the range of a number."""
    schema = setting_schemas()[str(location[0])][str(location[1])]
    return f"{schema['minimum']} to {schema['maximum']} ({schema['type']})"


def _unknown(location: tuple[int | str, ...]) -> str:
    """That a setting or a section is unknown, with the name that is nearest to it."""
    schemas = setting_schemas()
    names = [f"{section}.{key}" for section, table in schemas.items() for key in table]
    if len(location) < 2:
        names = list(schemas)
    name = ".".join(map(str, location))
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0)[0]
    return f"unknown setting {name}: did you mean {nearest}?"
