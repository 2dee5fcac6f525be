"""Writes the tables of ``settings.md`` from the server's settings: ``make docs``."""

import json
import re
from pathlib import Path
from typing import Any

from triquad_server.settings.sections import IN_LEAVES
from triquad_server.settings.settings import setting_schemas

PAGE = Path(__file__).with_name("settings.md")

_HEAD = "| key | default | range | |\n|---|---|---|---|\n"


def with_tables(page: str) -> str:
    """The page, with a table of the settings below the heading of each section."""
    for section, schemas in setting_schemas().items():
        rows = [_row(key, schema) for key, schema in schemas.items()]
        table = _HEAD + "".join(rows)
        # The prose between heading and table, and that below the table, are written by hand.
        found = re.search(rf"## `\[{section}\]`[^|]*\n\n((?:\|.*\n)+)", page)
        if found is None:
            raise ValueError(f"{PAGE} has no section [{section}] with a table")
        page = page[: found.start(1)] + table + page[found.end(1) :]
    return page


def _row(key: str, schema: dict[str, Any]) -> str:
    default, meaning = json.dumps(schema["default"]), " ".join(schema["description"].split())
    shown = "none" if schema["default"] is None else f"`{default}`"
    if IN_LEAVES in schema:
        shown += f", {schema[IN_LEAVES]:g} leaves"
    return f"| `{key}` | {shown} | {_allowed(schema)} | {meaning} |\n"


def _allowed(schema: dict[str, Any]) -> str:
    if "anyOf" in schema:  # the other is that there is none
        return _allowed(schema["anyOf"][0])
    if "enum" in schema:
        return ", ".join(f"`{json.dumps(value)}`" for value in schema["enum"])
    if "prefixItems" in schema:
        return "[" + ", ".join(_allowed(item) for item in schema["prefixItems"]) + "]"
    if schema["type"] == "boolean":
        return "`true`, `false`"
    if schema["type"] in ("array", "string"):
        return "texts" if schema["type"] == "array" else "a text"
    return f"{schema['minimum']} to {schema['maximum']}"


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
