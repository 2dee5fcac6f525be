"""What each setting is: its type, range, default and meaning, as JSON schemas."""

from typing import Any

from triquad_server.settings.settings import Settings

SOURCE_SECTION = "sources.NAME"


def setting_schemas() -> dict[str, dict[str, Any]]:
    """The JSON schema of each setting: by section, then by key.

    The sections of all sources are one, ``sources.NAME``.
    """
    schema = Settings.model_json_schema()
    references = {**schema["properties"]}
    references[SOURCE_SECTION] = references.pop("sources")["additionalProperties"]
    return {
        section: schema["$defs"][reference["$ref"].rpartition("/")[2]]["properties"]
        for section, reference in references.items()
    }
